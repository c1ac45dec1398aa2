//! SPIR-V modules, word by word: their instructions, and freezing their specialization constants.
//!
//! A module is specialised here, not by the driver, since some cannot: Metal has one constant for each id and none that
//! sizes a workgroup or an array, as have old drivers of mobile devices. What a driver gets has plain constants only,
//! unless it is the one that cannot optimise those (`Properties::driver_specializes`).

use std::collections::{BTreeMap, BTreeSet};

/// Words before the first instruction.
pub(super) const HEADER: usize = 5;

// Opcodes and enumerants of the SPIR-V specification.
const OP_EXECUTION_MODE: u32 = 16;
const OP_TYPE_BOOL: u32 = 20;
const OP_TYPE_INT: u32 = 21;
const OP_CONSTANT_TRUE: u32 = 41;
const OP_CONSTANT_FALSE: u32 = 42;
const OP_CONSTANT: u32 = 43;
const OP_CONSTANT_COMPOSITE: u32 = 44;
const OP_SPEC_CONSTANT_TRUE: u32 = 48;
const OP_SPEC_CONSTANT_FALSE: u32 = 49;
const OP_SPEC_CONSTANT: u32 = 50;
const OP_SPEC_CONSTANT_COMPOSITE: u32 = 51;
const OP_SPEC_CONSTANT_OP: u32 = 52;
const OP_DECORATE: u32 = 71;
const DECORATION_SPEC_ID: u32 = 1;
const DECORATION_BUILT_IN: u32 = 11;
const BUILT_IN_WORKGROUP_SIZE: u32 = 25;
const MODE_LOCAL_SIZE: u32 = 17;

/// The instructions of a module, each with its opcode.
pub(super) fn instructions(code: &[u32]) -> impl Iterator<Item = (u32, &[u32])> {
    let mut rest = code.get(HEADER..).unwrap_or_default();
    std::iter::from_fn(move || {
        let first = *rest.first()?;
        let length = ((first >> 16) as usize).clamp(1, rest.len());
        let (instruction, after) = rest.split_at(length);
        rest = after;
        Some((first & 0xffff, instruction))
    })
}

fn put(code: &mut Vec<u32>, opcode: u32, operands: &[u32]) {
    code.push(((operands.len() as u32 + 1) << 16) | opcode);
    code.extend_from_slice(operands);
}

/// The module with its specialization constants as plain ones: those of `values`, which are ids and bits, and their
/// defaults. The workgroup size is that of the execution mode.
pub(super) fn frozen(code: &[u32], values: &[(u32, u32)]) -> Vec<u32> {
    let constants = Constants::new(code, values);
    let mut frozen = code[..HEADER.min(code.len())].to_vec();
    for (opcode, instruction) in instructions(code) {
        let operands = &instruction[1..];
        match (opcode, operands) {
            (OP_DECORATE, [_, DECORATION_SPEC_ID, ..])
            | (OP_DECORATE, [_, DECORATION_BUILT_IN, BUILT_IN_WORKGROUP_SIZE]) => {}
            (OP_EXECUTION_MODE, [entry, MODE_LOCAL_SIZE, size @ ..]) => {
                let size = constants.workgroup_size().unwrap_or_else(|| size.to_vec());
                let operands = [&[*entry, MODE_LOCAL_SIZE], &*size].concat();
                put(&mut frozen, opcode, &operands);
            }
            (OP_SPEC_CONSTANT_COMPOSITE, _) => put(&mut frozen, OP_CONSTANT_COMPOSITE, operands),
            (OP_SPEC_CONSTANT_TRUE..=OP_SPEC_CONSTANT_OP, [ty, result, ..]) => {
                match constants.scalars.get(result) {
                    Some(&bits) if !constants.bools.contains(ty) => {
                        put(&mut frozen, OP_CONSTANT, &[*ty, *result, bits]);
                    }
                    Some(0) => put(&mut frozen, OP_CONSTANT_FALSE, &[*ty, *result]),
                    Some(_) => put(&mut frozen, OP_CONSTANT_TRUE, &[*ty, *result]),
                    None => frozen.extend_from_slice(instruction),
                }
            }
            _ => frozen.extend_from_slice(instruction),
        }
    }
    frozen
}

/// The values of a module's constants.
#[derive(Default)]
struct Constants {
    bools: BTreeSet<u32>,
    /// Types of 32 bits.
    ints: BTreeSet<u32>,
    /// Bits by the constant's id; of booleans 0 and 1.
    scalars: BTreeMap<u32, u32>,
    /// Ids of the constituents.
    composites: BTreeMap<u32, Vec<u32>>,
    /// The constant with the built-in workgroup size.
    workgroup_size: Option<u32>,
}

impl Constants {
    fn new(code: &[u32], values: &[(u32, u32)]) -> Self {
        let values: BTreeMap<u32, u32> = values.iter().copied().collect();
        let (mut all, mut specialised) = (Self::default(), BTreeMap::new());
        for (opcode, instruction) in instructions(code) {
            let value = |result: &u32| specialised.get(result).copied();
            match (opcode, &instruction[1..]) {
                (OP_DECORATE, [target, DECORATION_SPEC_ID, id]) => {
                    specialised.extend(values.get(id).map(|&bits| (*target, bits)));
                }
                (OP_DECORATE, [target, DECORATION_BUILT_IN, BUILT_IN_WORKGROUP_SIZE]) => {
                    all.workgroup_size = Some(*target);
                }
                (OP_TYPE_BOOL, [ty]) => drop(all.bools.insert(*ty)),
                (OP_TYPE_INT, [ty, 32, _]) => drop(all.ints.insert(*ty)),
                (OP_CONSTANT_TRUE | OP_SPEC_CONSTANT_TRUE, [_, result]) => {
                    all.scalars.insert(*result, value(result).map_or(1, |bits| (bits != 0).into()));
                }
                (OP_CONSTANT_FALSE | OP_SPEC_CONSTANT_FALSE, [_, result]) => {
                    all.scalars.insert(*result, value(result).map_or(0, |bits| (bits != 0).into()));
                }
                (OP_CONSTANT | OP_SPEC_CONSTANT, [_, result, default]) => {
                    all.scalars.insert(*result, value(result).unwrap_or(*default));
                }
                (
                    OP_CONSTANT_COMPOSITE | OP_SPEC_CONSTANT_COMPOSITE,
                    [_, result, constituents @ ..],
                ) => drop(all.composites.insert(*result, constituents.to_vec())),
                (OP_SPEC_CONSTANT_OP, [ty, result, operation, operands @ ..])
                    if all.ints.contains(ty) || all.bools.contains(ty) =>
                {
                    all.scalars.extend(all.evaluated(*operation, operands).map(|v| (*result, v)));
                }
                _ => {}
            }
        }
        all
    }

    /// An operation on scalars, if it is one of those that glslang makes of the constants of our kernels; another one
    /// is left to the driver.
    fn evaluated(&self, operation: u32, operands: &[u32]) -> Option<u32> {
        const COMPOSITE_EXTRACT: u32 = 81;
        if let (COMPOSITE_EXTRACT, [composite, at]) = (operation, operands) {
            return self.scalars.get(self.composites.get(composite)?.get(*at as usize)?).copied();
        }
        let values: Option<Vec<u32>> =
            operands.iter().map(|operand| self.scalars.get(operand).copied()).collect();
        let values = values?;
        Some(match (operation, &*values) {
            (128, &[a, b]) => a.wrapping_add(b), // IAdd
            (130, &[a, b]) => a.wrapping_sub(b), // ISub
            (132, &[a, b]) => a.wrapping_mul(b), // IMul
            (134, &[a, b]) => a.checked_div(b)?, // UDiv
            (137, &[a, b]) => a.checked_rem(b)?, // UMod
            (166, &[a, b]) => a | b,             // LogicalOr
            (167, &[a, b]) => a & b,             // LogicalAnd
            (168, &[a]) => (a == 0).into(),      // LogicalNot
            (169, &[condition, a, b]) => [b, a][usize::from(condition != 0)], // Select
            (164 | 170, &[a, b]) => (a == b).into(), // LogicalEqual, IEqual
            (165 | 171, &[a, b]) => (a != b).into(), // LogicalNotEqual, INotEqual
            (172, &[a, b]) => (a > b).into(),    // UGreaterThan
            (174, &[a, b]) => (a >= b).into(),   // UGreaterThanEqual
            (176, &[a, b]) => (a < b).into(),    // ULessThan
            (178, &[a, b]) => (a <= b).into(),   // ULessThanEqual
            _ => return None,
        })
    }

    fn workgroup_size(&self) -> Option<Vec<u32>> {
        let size = self.composites.get(&self.workgroup_size?)?;
        size.iter().map(|constituent| self.scalars.get(constituent).copied()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn operations_on_constants_are_evaluated() {
        let (unsigned, boolean) = (1, 2);
        let mut code = vec![0x0723_0203, 0x0001_0500, 0, 99, 0];
        for (id, target) in [(7, 10), (7, 11), (8, 12)] {
            put(&mut code, OP_DECORATE, &[target, DECORATION_SPEC_ID, id]);
        }
        put(&mut code, OP_TYPE_INT, &[unsigned, 32, 0]);
        put(&mut code, OP_TYPE_BOOL, &[boolean]);
        let head = code.len();
        for target in [10, 11] {
            put(&mut code, OP_SPEC_CONSTANT, &[unsigned, target, 1]);
        }
        put(&mut code, OP_SPEC_CONSTANT_TRUE, &[boolean, 12]);
        put(&mut code, OP_CONSTANT, &[unsigned, 13, 3]);
        put(&mut code, OP_SPEC_CONSTANT_OP, &[unsigned, 14, 132, 10, 13]); // IMul
        put(&mut code, OP_SPEC_CONSTANT_OP, &[boolean, 15, 176, 14, 13]); // ULessThan
        put(&mut code, OP_SPEC_CONSTANT_OP, &[unsigned, 16, 134, 14, 17]); // of what is not known
        let mut expected = code[..HEADER].to_vec();
        expected.extend(&code[HEADER + 3 * 4..head]);
        for target in [10, 11] {
            put(&mut expected, OP_CONSTANT, &[unsigned, target, 5]);
        }
        put(&mut expected, OP_CONSTANT_FALSE, &[boolean, 12]);
        put(&mut expected, OP_CONSTANT, &[unsigned, 13, 3]);
        put(&mut expected, OP_CONSTANT, &[unsigned, 14, 15]);
        put(&mut expected, OP_CONSTANT_FALSE, &[boolean, 15]);
        put(&mut expected, OP_SPEC_CONSTANT_OP, &[unsigned, 16, 134, 14, 17]);
        assert_eq!(frozen(&code, &[(7, 5), (8, 0), (9, 1)]), expected);
        assert_eq!(frozen(&expected, &[(7, 6)]), expected);
        assert_eq!(frozen(&code[..3], &[]), code[..3]);
    }
}
