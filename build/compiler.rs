//! GLSL to SPIR-V, by glslang or, with feature `shaderc`, by shaderc.

use std::fs;
use std::path::Path;

pub(crate) use implementation::compile;

/// Defined for `reflected`: a kernel can hide from the reflection what that does not understand.
const REFLECTION: &str = "REFLECTION";

/// One kernel's SPIR-V: `reflected` is unoptimised, so that every name survives; `shipped` is what the device runs.
pub(crate) struct Spirv {
    pub(crate) reflected: Vec<u32>,
    pub(crate) shipped: Vec<u32>,
}

/// The text of an included file; includes are looked up by name in `shaders-glsl/include`.
pub(crate) fn include(name: &str) -> Option<(String, String)> {
    let path = Path::new(crate::SHADERS).join("include").join(name);
    Some((path.display().to_string(), fs::read_to_string(&path).ok()?))
}

/// Stem and text of every include, in a stable order.
pub(crate) fn includes() -> Vec<(String, String)> {
    let folder = Path::new(crate::SHADERS).join("include");
    let paths = fs::read_dir(folder).expect("the includes exist").map(|entry| {
        let path = entry.expect("a folder can be listed").path();
        let stem = path.file_stem().and_then(|stem| stem.to_str()).expect("an include has a name");
        (stem.to_owned(), fs::read_to_string(&path).expect("a listed file can be read"))
    });
    let mut includes: Vec<_> = paths.collect();
    includes.sort();
    includes
}

#[cfg(not(feature = "shaderc"))]
mod implementation {
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

    pub(crate) fn compile(path: &Path, source: &str) -> Spirv {
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
mod implementation {
    use std::path::Path;

    use shaderc::{
        CompileOptions, Compiler, EnvVersion, OptimizationLevel, ResolvedInclude, ShaderKind,
        SpirvVersion, TargetEnv,
    };

    use super::{REFLECTION, Spirv};

    pub(crate) fn compile(path: &Path, source: &str) -> Spirv {
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
