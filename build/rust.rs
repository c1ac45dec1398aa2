//! A description to Rust.

use std::fmt::Write as _;

use crate::reflection::{Buffer, Constant, Field, Kernel, Struct, Structs};

impl std::fmt::Display for Structs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.values().try_for_each(|(declared, _)| {
            writeln!(f, "/// `{}` as the shaders' includes declare it.", declared.name)?;
            write!(f, "{declared}")
        })
    }
}

impl std::fmt::Display for Struct {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, fields, size } = self;
        writeln!(f, "#[repr(C)]")?;
        writeln!(f, "#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]")?;
        writeln!(f, "pub struct {name} {{")?;
        for Field { name, ty, .. } in fields {
            writeln!(f, "    /// See the shader.\n    pub {name}: {ty},")?;
        }
        writeln!(f, "}}")?;
        for Field { name: field, offset, .. } in fields {
            writeln!(f, "const _: () = assert!(offset_of!({name}, {field}) == {offset});")?;
        }
        writeln!(f, "const _: () = assert!(size_of::<{name}>() == {size});\n")
    }
}

impl Constant {
    /// The default value as a Rust expression.
    fn default(&self) -> String {
        match self.ty.as_str() {
            "f32" => format!("f32::from_bits({:#x})", self.default),
            "bool" => format!("{}", self.default != 0),
            "i32" => format!("{}", self.default as i32),
            _ => format!("{}", self.default),
        }
    }

    /// The bits that the pipeline is specialised with.
    fn bits(&self) -> String {
        match self.ty.as_str() {
            "bool" => format!("u32::from(constants.{})", self.name),
            _ => format!("bytemuck::cast(constants.{})", self.name),
        }
    }
}

impl Kernel {
    pub(crate) fn write(&self, out: &mut String) {
        let Self { name, docs, workgroup_size, params, constants, subgroup_size_id, buffers } =
            self;
        let docs: String = docs.iter().map(|line| format!("///{line}\n")).collect();
        let list = |line: &dyn Fn(&Buffer, &str) -> String| -> String {
            buffers.iter().map(|b| line(b, if b.writable { "mut " } else { "" })).collect()
        };
        let device = list(&|b, m| {
            format!(
                "    /// Binding {}.\n    pub {}: &'a {m}gpu::Buffer<{}>,\n",
                b.binding, b.name, b.element
            )
        });
        let host = list(&|b, m| {
            format!("    /// Binding {}.\n    pub {}: &'a {m}[{}],\n", b.binding, b.name, b.element)
        });
        let bindings = list(&|b, _| {
            format!(
                "gpu::Binding {{ name: {:?}, index: {}, writable: {}, is_float: {} }}, ",
                b.name, b.binding, b.writable, b.is_float
            )
        });
        let bound = list(&|b, _| format!("buffers.{}.bound(), ", b.name));
        let slices = list(&|b, _| {
            let cast = if b.writable { "cast_slice_mut" } else { "cast_slice" };
            format!("{}: bytemuck::{cast}(words.next().unwrap_or_default()), ", b.name)
        });
        let written = |line: &dyn Fn(&str) -> String| -> String {
            buffers.iter().filter(|b| b.writable).map(|b| line(&b.name)).collect()
        };
        let tolerances =
            written(&|name| format!("    /// Of `{name}`.\n    pub {name}: gpu::Tolerance,\n"));
        let listed = written(&|name| format!("tolerances.{name}, "));
        let fields: String = constants
            .iter()
            .map(|c| {
                format!(
                    "    /// Specialization constant {}.\n    pub {}: {},\n",
                    c.id, c.name, c.ty
                )
            })
            .collect();
        let defaults: String =
            constants.iter().map(|c| format!("{}: {}, ", c.name, c.default())).collect();
        let values: String =
            constants.iter().map(|c| format!("({}, {}), ", c.id, c.bits())).collect();

        write!(
            out,
            r#"{docs}pub mod {name} {{
use super::*;

/// `{name}.comp`
#[derive(Debug)]
pub enum Kernel {{}}

/// The push constants.
{params}
/// The specialization constants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Constants {{
{fields}}}

impl Default for Constants {{
    fn default() -> Self {{ Self {{ {defaults}}} }}
}}

/// What a dispatch binds: `&` where the shader says `readonly`, else `&mut`.
#[derive(Debug)]
pub struct Buffers<'a> {{
{device}}}

/// The same buffers in host memory, for the CPU reference.
#[derive(Debug)]
pub struct Slices<'a> {{
{host}}}

/// How far each buffer that it writes may be from the reference's.
#[derive(Clone, Debug, Default)]
pub struct Tolerances {{
{tolerances}}}

impl From<Tolerances> for Vec<gpu::Tolerance> {{
    fn from(tolerances: Tolerances) -> Self {{ vec![{listed}] }}
}}

impl gpu::Kernel for Kernel {{
    const NAME: &'static str = {name:?};
    const SPIRV: &'static [u8] = include_bytes!(concat!(env!("OUT_DIR"), "/{name}.spv"));
    const WORKGROUP_SIZE: [u32; 3] = {workgroup_size:?};
    const SUBGROUP_SIZE_ID: Option<u32> = {subgroup_size_id:?};
    const BINDINGS: &'static [gpu::Binding] = &[{bindings}];
    type Params = Params;
    type Constants = Constants;
    type Buffers<'a> = Buffers<'a>;
    type Slices<'a> = Slices<'a>;
    fn constants(constants: &Constants) -> Vec<(u32, u32)> {{ let _ = constants; vec![{values}] }}
    type Tolerances = Tolerances;
    fn bound(buffers: &Buffers<'_>) -> Vec<gpu::Bound> {{ vec![{bound}] }}
    fn slices(words: &mut [Vec<u32>]) -> Slices<'_> {{
        let mut words = words.iter_mut().map(Vec::as_mut_slice);
        Slices {{ {slices}}}
    }}
}}
}}

"#
        )
        .expect("writing to a string");
    }
}
