//! SPIR-V to a description of the kernel.

use std::collections::BTreeMap;
use std::path::Path;

use spirq::prelude::*;
use spirq::spirv::ExecutionMode;
use spirq::ty::{AccessType, DescriptorType, ScalarType, StructType, Type};
use spirq::var::Variable;

/// The largest push constant block that every Vulkan device accepts, in bytes.
const MAX_PARAMS_SIZE: usize = 128;

/// The specialization constant that the host sets to the device's subgroup size.
const SUBGROUP_SIZE: &str = "SUBGROUP_SIZE";

pub(crate) struct Kernel {
    pub(crate) name: String,
    pub(crate) docs: Vec<String>,
    /// Along x, zero stands for the device's subgroup size.
    pub(crate) workgroup_size: [u32; 3],
    pub(crate) params: Struct,
    pub(crate) constants: Vec<Constant>,
    pub(crate) subgroup_size_id: Option<u32>,
    pub(crate) buffers: Vec<Buffer>,
}

pub(crate) struct Constant {
    pub(crate) name: String,
    pub(crate) id: u32,
    pub(crate) ty: String,
    pub(crate) default: u32,
}

pub(crate) struct Buffer {
    pub(crate) name: String,
    pub(crate) binding: u32,
    pub(crate) element: String,
    pub(crate) writable: bool,
    /// Its elements are made of floats; else of integers.
    pub(crate) is_float: bool,
}

#[derive(PartialEq)]
pub(crate) struct Struct {
    pub(crate) name: String,
    pub(crate) fields: Vec<Field>,
    pub(crate) size: usize,
}

#[derive(PartialEq)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) offset: usize,
    pub(crate) ty: String,
}

/// The structs that kernels share through includes, with the kernel that first declared each.
#[derive(Default)]
pub(crate) struct Structs(pub(crate) BTreeMap<String, (Struct, String)>);

impl Kernel {
    pub(crate) fn reflect(path: &Path, source: &str, spirv: &[u32], structs: &mut Structs) -> Self {
        let mut entries = ReflectConfig::new()
            .spv(spirv)
            .ref_all_rscs(true)
            .reflect()
            .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let entry = entries.remove(0);
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        let mut kernel = Self {
            name: stem.expect("a kernel has a name").to_owned(),
            docs: source.lines().filter_map(|l| l.strip_prefix("//!")).map(str::to_owned).collect(),
            workgroup_size: workgroup_size(&entry),
            params: Struct { name: "Params".to_owned(), fields: vec![], size: 0 },
            constants: vec![],
            subgroup_size_id: None,
            buffers: vec![],
        };
        let defaults = spec_constant_defaults(spirv);
        for variable in entry.vars {
            kernel.add(variable, &defaults, structs);
        }
        if kernel.subgroup_size_id.is_some() {
            kernel.workgroup_size[0] = 0;
        }
        kernel.take_quads_apart();
        kernel.buffers.sort_by_key(|buffer| buffer.binding);
        kernel.constants.sort_by_key(|constant| constant.id);
        kernel
    }

    /// An array of `vec4` moves plain floats four at a time, and the host sees the floats; beside one, an array of
    /// `uvec4` moves plain words. Elsewhere four words are one value.
    fn take_quads_apart(&mut self) {
        let floats = |buffer: &Buffer| buffer.element == "[f32; 4]";
        if self.buffers.iter().any(floats) {
            for buffer in &mut self.buffers {
                let element = buffer.element.strip_prefix('[');
                if let Some(element) = element.and_then(|element| element.strip_suffix("; 4]")) {
                    buffer.element = element.to_owned();
                }
            }
        }
    }

    fn add(&mut self, variable: Variable, defaults: &BTreeMap<u32, u32>, structs: &mut Structs) {
        let kernel = self.name.clone();
        match variable {
            Variable::PushConstant { ty: Type::Struct(params), .. } => {
                self.params = structs.describe("Params", &params, &kernel);
                let size = self.params.size;
                assert!(size <= MAX_PARAMS_SIZE, "{kernel}: Params takes {size} bytes");
            }
            Variable::SpecConstant { name, spec_id, .. }
                if name.as_deref() == Some(SUBGROUP_SIZE) =>
            {
                self.subgroup_size_id = Some(spec_id);
            }
            Variable::SpecConstant { name: Some(name), spec_id, ty } => {
                self.constants.push(Constant {
                    name: name.to_lowercase(),
                    id: spec_id,
                    ty: structs.rust_type(&ty, &kernel),
                    default: defaults[&spec_id],
                });
            }
            // The workgroup size itself, where it is specialised.
            Variable::SpecConstant { name: None, .. } => {}
            Variable::Descriptor {
                desc_bind,
                desc_ty: DescriptorType::StorageBuffer(access),
                ty: Type::Struct(block),
                ..
            } => {
                let [member] = block.members.as_slice() else {
                    panic!("{kernel}: a buffer block declares one array and nothing else")
                };
                let Type::Array(array) = &member.ty else {
                    panic!("{kernel}: {:?} is not an array", member.name)
                };
                let element = structs.rust_type(&array.element_ty, &kernel);
                let size = array.element_ty.min_nbyte();
                assert_eq!(array.stride, size, "{kernel}: {element} is padded");
                self.buffers.push(Buffer {
                    name: member.name.clone().expect("names are kept"),
                    binding: desc_bind.bind(),
                    element,
                    writable: access != AccessType::ReadOnly,
                    is_float: is_float(&array.element_ty),
                });
            }
            other => panic!("{kernel}: {other:?} has no Rust counterpart"),
        }
    }
}

/// `SpecId` to the bits of the default value, read off the module's words (the reflection does not tell).
fn spec_constant_defaults(spirv: &[u32]) -> BTreeMap<u32, u32> {
    const OP_SPEC_CONSTANT_TRUE: u32 = 48;
    const OP_SPEC_CONSTANT_FALSE: u32 = 49;
    const OP_SPEC_CONSTANT: u32 = 50;
    const OP_DECORATE: u32 = 71;
    const DECORATION_SPEC_ID: u32 = 1;
    let (mut ids, mut values) = (BTreeMap::new(), BTreeMap::new());
    let mut at = 5;
    while at < spirv.len() {
        let words = (spirv[at] >> 16) as usize;
        match (spirv[at] & 0xffff, &spirv[at + 1..at + words]) {
            (OP_DECORATE, [target, DECORATION_SPEC_ID, id]) => drop(ids.insert(*target, *id)),
            (OP_SPEC_CONSTANT, [_, result, value]) => drop(values.insert(*result, *value)),
            (OP_SPEC_CONSTANT_TRUE, [_, result]) => drop(values.insert(*result, 1)),
            (OP_SPEC_CONSTANT_FALSE, [_, result]) => drop(values.insert(*result, 0)),
            _ => {}
        }
        at += words;
    }
    ids.into_iter().filter_map(|(target, id)| Some((id, *values.get(&target)?))).collect()
}

/// Whether an element is made of 32-bit floats alone: such buffers are compared as numbers, all others as bits.
fn is_float(ty: &Type) -> bool {
    match ty {
        Type::Scalar(ScalarType::Float { bits: 32 }) => true,
        Type::Scalar(ScalarType::Integer { bits: 32, .. }) => false,
        Type::Vector(vector) => is_float(&Type::Scalar(vector.scalar_ty.clone())),
        Type::Matrix(_) => true,
        Type::Array(array) => is_float(&array.element_ty),
        Type::Struct(ty) => ty.members.iter().all(|member| is_float(&member.ty)),
        other => panic!("{other:?} is no element of a buffer"),
    }
}

fn workgroup_size(entry: &EntryPoint) -> [u32; 3] {
    let mode = entry.exec_modes.iter().find(|mode| mode.exec_mode == ExecutionMode::LocalSize);
    let size: Vec<u32> = mode
        .expect("a compute shader declares its workgroup size")
        .operands
        .iter()
        .map(|operand| match &operand.value {
            ConstantValue::Typeless(bytes) => {
                u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
            }
            ConstantValue::U32(value) => *value,
            other => panic!("workgroup size is {other:?}"),
        })
        .collect();
    size.try_into().expect("three dimensions")
}

impl Structs {
    fn describe(&mut self, name: &str, ty: &StructType, kernel: &str) -> Struct {
        let fields: Vec<Field> = ty
            .members
            .iter()
            .map(|member| Field {
                name: member.name.clone().expect("names are kept"),
                offset: member.offset.expect("a block member has an offset"),
                ty: self.rust_type(&member.ty, kernel),
            })
            .collect();
        Struct { name: name.to_owned(), fields, size: ty.min_nbyte().expect("a sized struct") }
    }

    fn rust_type(&mut self, ty: &Type, kernel: &str) -> String {
        match ty {
            Type::Scalar(ScalarType::Boolean) => "bool".to_owned(),
            Type::Scalar(ScalarType::Float { bits }) => format!("f{bits}"),
            Type::Scalar(ScalarType::Integer { bits, is_signed: false }) => format!("u{bits}"),
            Type::Scalar(ScalarType::Integer { bits, is_signed: true }) => format!("i{bits}"),
            // glam aligns its four-wide types to sixteen bytes; scalar layout does not.
            Type::Vector(vector) => {
                let scalar = self.rust_type(&Type::Scalar(vector.scalar_ty.clone()), kernel);
                match (scalar.as_str(), vector.nscalar) {
                    ("f32", 2 | 3) => format!("glam::Vec{}", vector.nscalar),
                    ("u32", 2 | 3) => format!("glam::UVec{}", vector.nscalar),
                    ("i32", 2 | 3) => format!("glam::IVec{}", vector.nscalar),
                    _ => format!("[{scalar}; {}]", vector.nscalar),
                }
            }
            Type::Matrix(matrix) => {
                format!("[[f32; {}]; {}]", matrix.vector_ty.nscalar, matrix.nvector)
            }
            Type::Array(array) => {
                let element = self.rust_type(&array.element_ty, kernel);
                format!("[{element}; {}]", array.nelement.expect("a sized array"))
            }
            Type::Struct(ty) => {
                let name = ty.name.clone().expect("names are kept");
                let declared = self.describe(&name, ty, kernel);
                if let Some((known, first)) = self.0.get(&name) {
                    let same = *known == declared;
                    assert!(same, "{kernel} and {first} declare {name} differently");
                } else {
                    self.0.insert(name.clone(), (declared, kernel.to_owned()));
                }
                name
            }
            other => panic!("{kernel}: {other:?} has no Rust counterpart"),
        }
    }
}
