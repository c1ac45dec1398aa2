//! Compiles every kernel in `shaders-glsl/` and writes its Rust side.
//!
//! A kernel is declared once, in GLSL. Its SPIR-V tells us the parameters, buffers, constants and workgroup size, from
//! which `$OUT_DIR/kernels.rs` gets one typed module per kernel: host code that disagrees with a shader does not compile.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs};

use spirq::prelude::*;
use spirq::spirv::ExecutionMode;
use spirq::ty::{AccessType, DescriptorType, ScalarType, StructType, Type};
use spirq::var::Variable;

const SHADERS: &str = "shaders-glsl";

/// The largest push constant block that every Vulkan device accepts, in bytes.
const MAX_PARAMS_SIZE: usize = 128;

/// The specialization constant that the host sets to the device's subgroup size.
const SUBGROUP_SIZE: &str = "SUBGROUP_SIZE";

fn main() {
    println!("cargo:rerun-if-changed={SHADERS}");
    println!("cargo:rerun-if-changed=build.rs");
    let out_dir = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));

    let mut structs = Structs::default();
    let mut kernels = String::new();
    let mut names = BTreeSet::new();
    for path in kernel_paths(Path::new(SHADERS)) {
        let source = fs::read_to_string(&path).expect("a listed file can be read");
        let compiled = compiler::compile(&path, &source);
        let kernel = Kernel::reflect(&path, &source, &compiled.reflected, &mut structs);
        assert!(names.insert(kernel.name.clone()), "two kernels are called {}", kernel.name);
        let bytes: Vec<u8> = compiled.shipped.iter().flat_map(|word| word.to_le_bytes()).collect();
        fs::write(out_dir.join(&kernel.name).with_extension("spv"), bytes)
            .expect("OUT_DIR is ours");
        kernel.write(&mut kernels);
    }
    let kernels = structs.to_string() + &curve_numbers() + &kernels;
    fs::write(out_dir.join("kernels.rs"), kernels).expect("OUT_DIR is ours");
}

/// The numbers of the tone curves, so that host and shaders cannot number them differently.
fn curve_numbers() -> String {
    let (_, source) = include("curves.glsl").expect("the curves have an include");
    let number = |line: &str| {
        let (name, value) = line.strip_prefix("const uint ")?.split_once('=')?;
        let (name, value) = (name.trim(), value.trim().trim_end_matches(';'));
        Some(format!("/// See `include/curves.glsl`.\npub const {name}: u32 = {value};\n"))
    };
    source.lines().filter_map(number).collect()
}

/// Every `.comp` below `dir`, in a stable order.
fn kernel_paths(dir: &Path) -> Vec<PathBuf> {
    let mut paths = vec![];
    for entry in fs::read_dir(dir).expect("the shader folder exists") {
        let path = entry.expect("a folder can be listed").path();
        if path.is_dir() {
            paths.extend(kernel_paths(&path));
        } else if path.extension().is_some_and(|extension| extension == "comp") {
            paths.push(path);
        }
    }
    paths.sort();
    paths
}

// ---------------------------------------------------------------------------
// GLSL to SPIR-V

/// Defined for `reflected`: a kernel can hide from the reflection what that does not understand.
const REFLECTION: &str = "REFLECTION";

/// One kernel's SPIR-V: `reflected` is unoptimised, so that every name survives; `shipped` is what the device runs.
struct Spirv {
    reflected: Vec<u32>,
    shipped: Vec<u32>,
}

/// The text of an included file; includes are looked up by name in `shaders-glsl/include`.
fn include(name: &str) -> Option<(String, String)> {
    let path = Path::new(SHADERS).join("include").join(name);
    Some((path.display().to_string(), fs::read_to_string(&path).ok()?))
}

#[cfg(not(feature = "shaderc"))]
mod compiler {
    use std::path::Path;

    use glslang::include::{IncludeHandler, IncludeResult, IncludeType};
    use glslang::{
        Compiler, CompilerOptions, Shader, ShaderInput, ShaderSource, ShaderStage, SpirvVersion,
        Target, VulkanVersion,
    };

    use super::{REFLECTION, Spirv};

    struct Includes;

    impl IncludeHandler for Includes {
        fn include(
            &mut self,
            _: IncludeType,
            name: &str,
            _: &str,
            _: usize,
        ) -> Option<IncludeResult> {
            super::include(name).map(|(name, data)| IncludeResult { name, data })
        }
    }

    pub(super) fn compile(path: &Path, source: &str) -> Spirv {
        let compiler = Compiler::acquire().expect("glslang starts");
        let options = CompilerOptions {
            target: Target::Vulkan {
                version: VulkanVersion::Vulkan1_3,
                spirv_version: SpirvVersion::SPIRV1_5,
            },
            ..Default::default()
        };
        let hides = source.contains(REFLECTION);
        let source = ShaderSource::from(source.to_owned());
        let build = |defines: Option<&[(&str, Option<&str>)]>| {
            let mut includes = Includes;
            ShaderInput::new(&source, ShaderStage::Compute, &options, defines, Some(&mut includes))
                .and_then(|input| Shader::new(compiler, input).parse())
                .and_then(|shader| shader.compile())
                .unwrap_or_else(|error| panic!("{}: {error}", path.display()))
        };
        let shipped = build(None);
        let reflected = if hides { build(Some(&[(REFLECTION, None)])) } else { shipped.clone() };
        Spirv { reflected, shipped }
    }
}

#[cfg(feature = "shaderc")]
mod compiler {
    use std::path::Path;

    use shaderc::{
        CompileOptions, Compiler, EnvVersion, OptimizationLevel, ResolvedInclude, ShaderKind,
        SpirvVersion, TargetEnv,
    };

    use super::{REFLECTION, Spirv};

    pub(super) fn compile(path: &Path, source: &str) -> Spirv {
        let compiler = Compiler::new().expect("shaderc starts");
        let build = |level| {
            let mut options = CompileOptions::new().expect("shaderc starts");
            options.set_target_env(TargetEnv::Vulkan, EnvVersion::Vulkan1_3 as u32);
            options.set_target_spirv(SpirvVersion::V1_5);
            options.set_optimization_level(level);
            if level == OptimizationLevel::Zero {
                options.add_macro_definition(REFLECTION, None);
            }
            options.set_include_callback(|name, _, _, _| {
                let (resolved_name, content) =
                    super::include(name).ok_or_else(|| format!("{name} is not in include/"))?;
                Ok(ResolvedInclude { resolved_name, content })
            });
            let name = path.display().to_string();
            compiler
                .compile_into_spirv(source, ShaderKind::Compute, &name, "main", Some(&options))
                .unwrap_or_else(|error| panic!("{name}: {error}"))
                .as_binary()
                .to_vec()
        };
        Spirv {
            reflected: build(OptimizationLevel::Zero),
            shipped: build(OptimizationLevel::Performance),
        }
    }
}

// ---------------------------------------------------------------------------
// SPIR-V to a description

struct Kernel {
    name: String,
    docs: Vec<String>,
    /// Along x, zero stands for the device's subgroup size.
    workgroup_size: [u32; 3],
    params: Struct,
    constants: Vec<Constant>,
    subgroup_size_id: Option<u32>,
    buffers: Vec<Buffer>,
}

struct Constant {
    name: String,
    id: u32,
    ty: String,
    default: u32,
}

struct Buffer {
    name: String,
    binding: u32,
    element: String,
    writable: bool,
}

#[derive(PartialEq)]
struct Struct {
    name: String,
    fields: Vec<Field>,
    size: usize,
}

#[derive(PartialEq)]
struct Field {
    name: String,
    offset: usize,
    ty: String,
}

/// The structs that kernels share through includes, with the kernel that first declared each.
#[derive(Default)]
struct Structs(BTreeMap<String, (Struct, String)>);

impl Kernel {
    fn reflect(path: &Path, source: &str, spirv: &[u32], structs: &mut Structs) -> Self {
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
            kernel.workgroup_size = [0, 1, 1];
        }
        kernel.buffers.sort_by_key(|buffer| buffer.binding);
        kernel.constants.sort_by_key(|constant| constant.id);
        kernel
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
                let element = structs.element_type(&array.element_ty, &kernel);
                let size = array.element_ty.min_nbyte();
                assert_eq!(array.stride, size, "{kernel}: {element} is padded");
                self.buffers.push(Buffer {
                    name: member.name.clone().expect("names are kept"),
                    binding: desc_bind.bind(),
                    element,
                    writable: access != AccessType::ReadOnly,
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

    /// The element of a buffer: an array of `vec4` moves plain floats four at a time, and the host sees the floats.
    fn element_type(&mut self, ty: &Type, kernel: &str) -> String {
        match self.rust_type(ty, kernel).as_str() {
            "[f32; 4]" => "f32".to_owned(),
            other => other.to_owned(),
        }
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

// ---------------------------------------------------------------------------
// A description to Rust

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
    fn write(&self, out: &mut String) {
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
                "gpu::Binding {{ name: {:?}, index: {}, writable: {} }}, ",
                b.name, b.binding, b.writable
            )
        });
        let handles = list(&|b, _| format!("buffers.{}.handle(), ", b.name));
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
    fn handles(buffers: &Buffers<'_>) -> Vec<ash::vk::Buffer> {{ vec![{handles}] }}
}}
}}

"#
        )
        .expect("writing to a string");
    }
}
