//! A description to Rust.

use std::fmt::Write as _;

use super::glsl::{self, Text};
use super::reflection::{Buffer, Constant, Field, Kernel, Struct, Structs};

/// The struct that measurements on the host fill; here only its layout is checked.
const OF_CORE: &str = "ToneParameters";

impl Structs {
    /// The structs that kernels share, with what `text` says of them.
    pub(crate) fn write(&self, text: &Text) -> String {
        let write = |(declared, _): &(Struct, String)| {
            if declared.name == OF_CORE {
                return format!(
                    "pub use nightsplat_core::curves::{OF_CORE};\n{}",
                    declared.layout()
                );
            }
            let docs = format!("/// `{}` as the shaders' includes declare it.", declared.name);
            format!("{docs}\n{}", declared.write(text))
        };
        self.0.values().map(write).collect()
    }
}

impl Struct {
    fn write(&self, text: &Text) -> String {
        let Self { name, fields, .. } = self;
        let layout = self.layout();
        let members: String = fields.iter().map(|field| member(text, name, field)).collect();
        format!(
            "#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct {name} {{
{members}}}
{layout}
"
        )
    }

    /// Checks of its layout.
    fn layout(&self) -> String {
        let Self { name, fields, size } = self;
        let offsets: String = fields
            .iter()
            .map(|Field { name: field, offset, .. }| {
                format!("const _: () = assert!(offset_of!({name}, {field}) == {offset});\n")
            })
            .collect();
        format!("{offsets}const _: () = assert!(size_of::<{name}>() == {size});\n")
    }
}

/// A field with what its declaration says.
fn member(text: &Text, block: &str, Field { name, ty, .. }: &Field) -> String {
    let docs = glsl::rustdoc(text.comment(block, name), &format!("`{name}` of the shader."));
    format!("{docs}    pub {name}: {ty},\n")
}

/// A buffer of a dispatch with its binding and what its declaration says.
fn binding(text: &Text, Buffer { name, binding, .. }: &Buffer, ty: &str) -> String {
    let comment = format!("Binding {binding}: {}", text.comment(glsl::BUFFER, name));
    format!("{}    pub {name}: {ty},\n", glsl::rustdoc(comment.trim_end_matches(": "), ""))
}

impl Constant {
    /// A field of `Constants` with what its declaration says.
    fn field(&self, text: &Text) -> String {
        let Self { name, id, ty, .. } = self;
        let comment = text.comment("", &name.to_uppercase());
        let comment = format!("Specialization constant {id}: {comment}");
        format!("{}    pub {name}: {ty},\n", glsl::rustdoc(comment.trim_end_matches(": "), ""))
    }

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
    /// Its element of the list of all kernels.
    pub(crate) fn entry(&self) -> String {
        let kernel = format!("<{}::Kernel as gpu::Kernel>", self.name);
        format!("    ({kernel}::INTERFACE, || {kernel}::constants(&Default::default())),\n")
    }

    pub(crate) fn write(&self, text: &Text, out: &mut String) {
        let Self { name, docs, workgroup_size, params, constants, subgroup_size_id, buffers } =
            self;
        let docs: String = docs.iter().map(|line| format!("///{line}\n")).collect();
        let list =
            |line: &dyn Fn(&Buffer) -> String| -> String { buffers.iter().map(line).collect() };
        let device = list(&|b| {
            let slice = if b.writable { "SliceMut" } else { "Slice" };
            binding(text, b, &format!("gpu::{slice}<'a, {}>", b.element))
        });
        let host = list(&|b| {
            let mutable = if b.writable { "mut " } else { "" };
            binding(text, b, &format!("&'a {mutable}[{}]", b.element))
        });
        let bindings = list(&|b| {
            format!(
                "gpu::Binding {{ name: {:?}, index: {}, writable: {}, is_float: {} }}, ",
                b.name, b.binding, b.writable, b.is_float
            )
        });
        let bound = list(&|b| format!("buffers.{}.bound(), ", b.name));
        let slices = list(&|b| {
            let cast = if b.writable { "cast_slice_mut" } else { "cast_slice" };
            format!("{}: bytemuck::{cast}(words.next().unwrap_or_default()), ", b.name)
        });
        let written = |line: &dyn Fn(&str) -> String| -> String {
            buffers.iter().filter(|b| b.writable).map(|b| line(&b.name)).collect()
        };
        let tolerances =
            written(&|name| format!("    /// Of `{name}`.\n    pub {name}: gpu::Tolerance,\n"));
        let listed = written(&|name| format!("tolerances.{name}, "));
        let fields: String = constants.iter().map(|constant| constant.field(text)).collect();
        let params = params.write(text);
        let own_constants = text.own_constants();
        let defaults: String =
            constants.iter().map(|c| format!("{}: {}, ", c.name, c.default())).collect();
        let values: String =
            constants.iter().map(|c| format!("({}, {}), ", c.id, c.bits())).collect();

        write!(
            out,
            r#"{docs}pub mod {name} {{
use super::*;

{own_constants}/// `{name}.comp`
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

/// What a dispatch binds: a `Slice` where the shader says `readonly`, else a `SliceMut`.
#[derive(Debug)]
pub struct Buffers<'a> {{
{device}}}

/// The same buffers in host memory, for the CPU reference.
#[cfg(feature = "train")]
#[derive(Debug)]
pub struct Slices<'a> {{
{host}}}

/// How far each buffer that it writes may be from the reference's.
#[cfg(feature = "train")]
#[derive(Clone, Debug, Default)]
pub struct Tolerances {{
{tolerances}}}

#[cfg(feature = "train")]
impl From<Tolerances> for Vec<gpu::Tolerance> {{
    fn from(tolerances: Tolerances) -> Self {{ vec![{listed}] }}
}}

impl gpu::Kernel for Kernel {{
    const INTERFACE: &'static gpu::Interface = &gpu::Interface {{
        name: {name:?},
        spirv: include_bytes!(concat!(env!("OUT_DIR"), "/{name}.spv")),
        workgroup_size: {workgroup_size:?},
        subgroup_size_id: {subgroup_size_id:?},
        bindings: &[{bindings}],
        params_size: size_of::<Params>(),
    }};
    type Params = Params;
    type Constants = Constants;
    type Buffers<'a> = Buffers<'a>;
    fn constants(constants: &Constants) -> Vec<(u32, u32)> {{ let _ = constants; vec![{values}] }}
    fn bound(buffers: &Buffers<'_>) -> Vec<gpu::Bound> {{ vec![{bound}] }}
}}

#[cfg(feature = "train")]
impl gpu::OnHost for Kernel {{
    type Slices<'a> = Slices<'a>;
    type Tolerances = Tolerances;
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
