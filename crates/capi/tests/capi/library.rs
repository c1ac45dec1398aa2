//! The library as C sees it: header, exports, layouts, and a host.

use std::process::Output;

use super::*;

/// The repository.
const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// The library and its header, laid out by `scripts/build-capi.sh`, once.
fn library() -> &'static Path {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| {
        let root = Path::new(ROOT);
        let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("capi");
        let mut command = Command::new(root.join("scripts/build-capi.sh"));
        command.arg(&out).env("NIGHTSPLAT_PROFILE", "dev").args(["--offline", "--quiet"]);
        // Of scripts/test.sh; with it, cargo would build the dependencies again.
        command.env_remove("RUSTC_BOOTSTRAP");
        let built = command.output().unwrap();
        assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
        let keep = "int dlclose(void *library) { return library == 0; }\n";
        // Instead of the library's: what it made of a model stays.
        let lose = "#include <nightsplat.h>\nvoid nsp_model_destroy(NspModel *it) { (void)it; }\n";
        for (name, text) in
            [("keep.c", keep), ("lose.c", lose), (SUPPRESSIONS, "leak:libvulkan_\n")]
        {
            std::fs::write(out.join(name), text).unwrap();
        }
        out
    })
}

/// Compiles a source file with every warning an error.
fn compile(compiler: &str, standard: &str, source: &Path, more: &[&str]) -> PathBuf {
    let library = library();
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let number = COUNT.fetch_add(1, Ordering::AcqRel);
    let out = library.join(format!("{}{number}", source.file_stem().unwrap().to_str().unwrap()));
    let mut command = Command::new(compiler);
    command.arg(standard).args(["-Wall", "-Wextra", "-pedantic", "-Werror"]).arg(source);
    command.arg("-I").arg(library.join("include")).args(more).arg("-o").arg(&out);
    let compiled = command.output().unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    out
}

/// Compiles an example that links with the library.
fn example(name: &str, more: &[&str]) -> PathBuf {
    linked(&Path::new(ROOT).join("examples/c").join(name), more)
}

/// Compiles a program that links with the library.
fn linked(source: &Path, more: &[&str]) -> PathBuf {
    let lib = library().join("lib").display().to_string();
    let [path, rpath] = [format!("-L{lib}"), format!("-Wl,-rpath,{lib}")];
    let linked = [&path, "-lnightsplat", "-lvulkan", "-lm", &rpath];
    compile("cc", "-std=c99", source, &[&linked, more].concat())
}

/// An example, and other sources, with our memory and the host's checked by the sanitizers of the compiler. Libraries
/// stay loaded: the report could not name a driver that has gone as the owner of what it leaks.
fn sanitized(name: &str, others: &[&str]) -> PathBuf {
    let others = ["keep.c"].iter().chain(others).map(|file| library().join(file));
    let others: Vec<String> = others.map(|path| path.display().to_string()).collect();
    let others = others.iter().map(String::as_str);
    let more = ["-g", "-fsanitize=address,undefined"].into_iter().chain(others);
    example(name, &more.collect::<Vec<_>>())
}

/// Drivers have leaks of their own.
const SUPPRESSIONS: &str = "drivers.supp";

/// Runs a host in the folder under this layer, which writes its messages to standard output.
fn run(program: &Path, folder: &Path, arguments: &[&str], layer: &str) -> Output {
    let synchronization = "VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT";
    let mut command = Command::new(program);
    command.current_dir(folder).args(arguments);
    command.env("VK_INSTANCE_LAYERS", layer).env("VK_LAYER_ENABLES", synchronization);
    let suppressions = library().join(SUPPRESSIONS);
    let options = format!("suppressions={}:print_suppressions=0", suppressions.display());
    command.env("LSAN_OPTIONS", options);
    command.output().unwrap()
}

/// What it printed; it must succeed.
fn printed(done: &Output) -> String {
    let printed = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success(), "{printed} {}", String::from_utf8_lossy(&done.stderr));
    printed
}

/// The Vulkan headers and the loader to link with; hosts have them.
fn has_vulkan_headers() -> bool {
    let found = Command::new("pkg-config").args(["--exists", "vulkan"]).status();
    let is_there = found.is_ok_and(|status| status.success());
    assert!(is_there || std::env::var_os("CI").is_none(), "install libvulkan-dev");
    if !is_there {
        not_run("vulkan-headers", "they are not installed (on Debian `apt install libvulkan-dev`)");
    }
    is_there
}

#[test]
fn the_c_host_draws_our_own_render_without_a_message() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let model = Model::from(gaussians(2));
    model.save(folder.path().join("model.ply")).unwrap();
    let layer = "VK_LAYER_KHRONOS_validation";
    let program = example("embed.c", &[]);
    let lines = printed(&run(&program, folder.path(), &["model.ply", "out.ppm"], layer));
    assert!(!lines.contains("Validation"), "{lines}");
    let file = std::fs::read(folder.path().join("out.ppm")).unwrap();
    let pixels = &file[file.len() - 3 * PIXELS..];
    assert_close(pixels, &own_render(&model));

    let checked = sanitized("embed.c", &[]);
    printed(&run(&checked, folder.path(), &["model.ply", "out.ppm"], ""));
    let leaks =
        run(&sanitized("embed.c", &["lose.c"]), folder.path(), &["model.ply", "out.ppm"], "");
    let report = String::from_utf8_lossy(&leaks.stderr);
    assert!(!leaks.status.success() && report.contains("LeakSanitizer"), "no leak: {report}");
    assert!(report.contains("libnightsplat.so"), "not of ours: {report}");

    let failed = run(&program, folder.path(), &["absent.ply", "out.ppm"], layer);
    let [stdout, error] =
        [&failed.stdout, &failed.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(!failed.status.success() && !stdout.contains("Validation"), "{stdout}");
    assert!(error.contains("nsp_model_load: absent.ply") && error.contains("(-3)"), "{error}");
}

/// `find_package`, and a program of one source.
const CMAKE: &str = "cmake_minimum_required(VERSION 3.16)
project(host C)
find_package(nightsplat CONFIG REQUIRED)
add_executable(host host.c)
target_link_libraries(host PRIVATE nightsplat::nightsplat)
";

/// As an archive of a release is, wherever it is unpacked.
#[test]
fn pkg_config_and_cmake_find_the_library_in_a_prefix_that_was_moved() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let prefix = folder.path().join("moved here");
    std::fs::create_dir(&prefix).unwrap();
    let copied = Command::new("cp")
        .args(["-a"])
        .args(["include", "lib"].map(|part| library().join(part)))
        .arg(&prefix)
        .status()
        .unwrap();
    assert!(copied.success());
    let source = folder.path().join("host.c");
    let program =
        "#include <nightsplat.h>\nint main(void) { return nsp_version() != NSP_HEADER_VERSION; }\n";
    std::fs::write(&source, program).unwrap();
    let succeeds = |command: &mut Command| match command.output() {
        Ok(done) if done.status.success() => Some(String::from_utf8(done.stdout).unwrap()),
        Ok(done) => panic!("{command:?}: {}", String::from_utf8_lossy(&done.stderr)),
        Err(error) => {
            let program = command.get_program().to_string_lossy();
            not_run("build-tools", format_args!("no {program}: {error}"));
            None
        }
    };
    let runs = |host: &Path| {
        let lib = prefix.join("lib");
        succeeds(Command::new(host).env("LD_LIBRARY_PATH", lib)).unwrap();
    };
    let mut pkg_config = Command::new("pkg-config");
    pkg_config.env("PKG_CONFIG_PATH", prefix.join("lib/pkgconfig"));
    if let Some(flags) = succeeds(pkg_config.args(["--cflags", "--libs", "nightsplat"])) {
        let host = folder.path().join("by-pkg-config");
        let line = format!("cc {} -o {} {flags}", source.display(), host.display());
        succeeds(Command::new("sh").args(["-c", &line])).unwrap();
        runs(&host);
    }
    std::fs::write(folder.path().join("CMakeLists.txt"), CMAKE).unwrap();
    let build = folder.path().join("build");
    let mut configure = Command::new("cmake");
    configure.arg("-S").arg(folder.path()).arg("-B").arg(&build);
    configure.arg(format!("-DCMAKE_PREFIX_PATH={}", prefix.display()));
    if succeeds(&mut configure).is_some() {
        succeeds(Command::new("cmake").arg("--build").arg(&build)).unwrap();
        runs(&build.join("host"));
    }
}

#[test]
fn no_wrong_call_ends_the_process() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    Model::from(gaussians(2)).save(folder.path().join("model.ply")).unwrap();
    for more in [&[][..], &["-g", "-fsanitize=address,undefined"]] {
        let program =
            linked(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/c/wrong_calls.c"), more);
        // Each case leaves what it made, and the layer's state of a forked process is not its own.
        let done = run(&program, folder.path(), &["model.ply"], "");
        let lines = printed(&done);
        assert!(lines.ends_with("0 of 12 cases are wrong\n"), "{lines}");
    }
}

#[test]
fn two_processes_share_images_and_one_goes_on_where_the_other_dies() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    Model::from(gaussians(1)).save(folder.path().join("model.ply")).unwrap();
    let share = |program: &Path, frames: &[&str], layer: &str| {
        printed(&run(program, folder.path(), &[&["model.ply"], frames].concat(), layer))
    };
    let lines = share(&example("share.c", &[]), &["7"], "VK_LAYER_KHRONOS_validation");
    // The layer of the reader does not know of the layout that the other process left its images in.
    let is_known = |line: &str| {
        line.contains("InvalidImageLayout") && line.ends_with("is VK_IMAGE_LAYOUT_UNDEFINED.")
    };
    let messages = lines.lines().filter(|line| line.contains("Validation") && !is_known(line));
    assert_eq!(messages.collect::<Vec<_>>(), [""; 0]);
    assert!(lines.contains("7 frames of 7 were read by the other process, 0 differ"), "{lines}");

    // Layers have leaks of their own.
    let checked = sanitized("share.c", &[]);
    share(&checked, &["5"], "");
    let lines = share(&checked, &["9", "4"], "");
    assert!(lines.contains("which is gone, 0 differ"), "{lines}");
}

#[test]
fn the_header_is_c_and_cpp_and_names_what_the_library_exports() {
    if !has_vulkan_headers() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("header.c");
    std::fs::write(&source, "#include <nightsplat.h>\nint main(void) { return 0; }\n").unwrap();
    compile("cc", "-std=c99", &source, &[]);
    compile("c++", "-std=c++11", &source, &["-x", "c++"]);
    let header = std::fs::read_to_string(library().join("include/nightsplat.h")).unwrap();
    let declared = header.lines().filter_map(|line| {
        let name = line.split('(').next()?.rsplit([' ', '*']).next()?;
        (line.contains('(') && !line.starts_with(['/', '#', ' ', '*']) && name.starts_with("nsp_"))
            .then(|| name.to_owned())
    });
    let declared: std::collections::BTreeSet<String> = declared.collect();
    let shared = library().join("lib/libnightsplat.so");
    let exported = Command::new("nm").args(["-D", "--defined-only"]).arg(shared).output().unwrap();
    let exported = String::from_utf8(exported.stdout).unwrap();
    let exported: std::collections::BTreeSet<String> = exported
        .lines()
        .filter_map(|line| line.split_whitespace().nth(2))
        .map(str::to_owned)
        .collect();
    assert_eq!(exported, declared);
    assert_eq!(nsp_version(), NSP_HEADER_VERSION);
}

/// Offsets in Rust, and the C that prints its own.
macro_rules! layouts {
    ($($name:ident { $($member:ident),* $(,)? })*) => {{
        let rust = vec![$(
            format!("{} {}", stringify!($name), size_of::<$name>()),
            $(format!(
                "{}.{} {}",
                stringify!($name), stringify!($member), std::mem::offset_of!($name, $member)
            ),)*
        )*];
        let c = vec![$(
            format!("printf(\"{0} %zu\\n\", sizeof({0}));", stringify!($name)),
            $(format!(
                "printf(\"{0}.{1} %zu\\n\", offsetof({0}, {1}));",
                stringify!($name), stringify!($member)
            ),)*
        )*];
        (rust, c)
    }};
}

#[test]
fn every_member_is_where_c_has_it() {
    if !has_vulkan_headers() {
        return;
    }
    let (rust, c) = layouts! {
        NspMemory { memory, offset, mapped, cookie }
        NspMemoryFunctions { struct_size, allocate, free, user }
        NspHostDevice {
            struct_size, get_instance_proc_addr, instance, physical_device, device, queue, queue_family, flags,
            extensions, extension_count, features, lock_queue, unlock_queue, user, pipeline_cache, host_memory,
            device_memory, frames,
        }
        NspFeatureStructs {
            struct_size, timeline_semaphore, scalar_block_layout, synchronization2, subgroup_size_control,
        }
        NspCamera {
            struct_size, width, height, focal, principal_point, view_from_world, flags, reserved, distortion,
        }
        NspModelInfo { struct_size, count, sh_degree, near_plane, max_alpha, raw_colors, law_stops, origin }
        NspImageState { layout, family, stages, access, is_owned, reserved }
        NspImage { struct_size, image, format, extent, layer, layers, before, after }
        NspRender {
            struct_size, commands, frame, cameras, camera_count, flags, color, depth_out, scene_depth, scene_near,
            scene_far, exposure, background, budget, instance_count, instances, hdr10_nits, pick,
            reserved, motion_out, cameras_before,
        }
        NspInstance {
            struct_size, model, trainer, pose, scale, tint, clip_min, clip_max, flags, reserved, pose_before,
            scale_before,
        }
        NspStatus { struct_size, frame, intersections, capacity, left_out, splats_per_tile, device_bytes }
        NspPick { struct_size, frame, is_hit, instance, gaussian, depth }
        NspStep { struct_size, step, loss, gaussians, reserved }
        NspScore { struct_size, step, psnr }
    };
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("offsets.c");
    let body = c.join("\n    ");
    let text = format!(
        "#include <nightsplat.h>\n#include <stdio.h>\nint main(void) {{\n    {body}\n    return 0;\n}}\n"
    );
    std::fs::write(&source, text).unwrap();
    let program = compile("cc", "-std=c99", &source, &[]);
    let printed = String::from_utf8(Command::new(program).output().unwrap().stdout).unwrap();
    assert_eq!(printed.lines().collect::<Vec<_>>(), rust);
}
