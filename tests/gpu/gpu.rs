//! The device layer: choosing a device, buffers at their limits, and all ways to launch work.

use nightsplat::Error;
use nightsplat::gpu::testing::{gpu_that_binds, misuse, not_run};
use nightsplat::gpu::{Buffer, DeviceChoice, Pipeline, Recorder, devices};
use nightsplat::kernels::{blend_forward, relu_backward};

use crate::common::prelude::*;

/// Threads of a workgroup of `relu_backward`.
const WORKGROUP: usize = 256;

fn relu_pipeline() -> Pipeline<relu_backward::Kernel> {
    gpu().pipeline(&relu_backward::Constants::default()).unwrap()
}

/// `count` ones, where this many threads of `relu_backward` write zeros.
fn ones_and_zeros(count: usize, threads: Threads) -> Vec<f32> {
    let (gpu, pipeline) = (gpu(), relu_pipeline());
    let activations = gpu.zeros("activations", count).unwrap();
    let mut gradient = gpu.buffer("gradient", &vec![1.0; count]).unwrap();
    gpu.run("ones and zeros", |pass| {
        let params = relu_backward::Params { value_count: count as u32 };
        let buffers = relu_backward::Buffers {
            activations: activations.slice(),
            gradient: gradient.slice_mut(),
        };
        pass.dispatch(&pipeline, &params, buffers, threads)
    })
    .unwrap();
    gpu.read(&gradient).unwrap()
}

// ---------------------------------------------------------------------------
// Devices

#[test]
fn an_unknown_device_is_refused_with_the_list_of_devices() {
    let all = devices().unwrap();
    for (text, wanted) in [
        ("no such device", "`no such device`"),
        ("99", "number 99"),
        ("uuid:fedcba98", "UUID begins with fedcba98"),
        ("pci:ffff:ff:1f.7", "at ffff:ff:1f.7"),
    ] {
        let error = Gpu::new(&text.parse().unwrap()).unwrap_err();
        let message = error.to_string();
        assert!(matches!(error, Error::NoDevice(_)) && message.contains(wanted), "{message}");
        assert!(all.iter().all(|device| message.contains(&device.name)), "{message}");
        assert!(!message.contains('\n'), "{message}");
    }
}

/// A run that must be on lavapipe, and is on another device, proves something else.
#[test]
fn tests_run_on_the_device_that_is_required() {
    let name = gpu().properties().name.clone();
    if !name.contains("llvmpipe") {
        not_run("lavapipe", format_args!("tests run on {name}"));
    }
}

#[test]
fn a_device_is_found_by_a_part_of_its_name_in_any_case() {
    let name = gpu().properties().name.clone();
    let part = name[..name.len() / 2].to_uppercase();
    let found = Gpu::new(&DeviceChoice::Name(part)).unwrap();
    assert_eq!(found.properties().name, name);
}

#[test]
fn every_device_is_found_by_its_uuid() {
    for device in devices().unwrap().iter().filter(|device| device.missing().is_none()) {
        let choice: DeviceChoice = format!("uuid:{}", device.uuid).parse().unwrap();
        assert_eq!(Gpu::new(&choice).unwrap().properties().name, device.name);
    }
}

#[test]
fn a_validation_message_fails_the_process_and_names_the_test() {
    const NAME: &str = "gpu::a_validation_message_fails_the_process_and_names_the_test";
    // The test runs itself again in a separate process, and then misuses the device.
    if std::env::var_os("MISUSE_THE_DEVICE").is_some() {
        return misuse(&gpu());
    }
    let mut child = Command::new(std::env::current_exe().unwrap());
    let child = child.args(["--exact", NAME, "--test-threads=2"]).env("MISUSE_THE_DEVICE", "1");
    let output = child.output().unwrap();
    let [stdout, stderr] =
        [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(stdout.contains("1 passed"), "the test itself must not notice: {stdout}");
    assert_eq!(output.status.code(), Some(101), "{stderr}");
    let prefix = format!("{NAME}: ");
    // Newer layers print more than one line.
    let message = stderr.split_once(&prefix).unwrap_or_default().1;
    assert!(message.contains("VUID-VkBufferCreateInfo-size-00912"), "{stderr}");
}

// ---------------------------------------------------------------------------
// Buffers

#[test]
fn a_buffer_of_no_elements_can_be_used_like_any_other() {
    let gpu = gpu();
    let mut empty: Buffer<u32> = gpu.zeros("empty", 0).unwrap();
    let mut other: Buffer<u32> = gpu.buffer("other", &[]).unwrap();
    assert!(empty.is_empty());
    gpu.write(&mut empty, &[]).unwrap();
    gpu.run("empty", |pass| {
        pass.fill(&mut empty, 7);
        pass.copy(&empty, &mut other);
        Ok(())
    })
    .unwrap();
    assert!(gpu.read(&other).unwrap().is_empty());
    assert!(ones_and_zeros(0, Threads::Exactly([0, 1, 1])).is_empty());
    assert!(ones_and_zeros(0, Threads::Exactly([1, 1, 1])).is_empty());
}

#[test]
fn a_buffer_beyond_the_limit_is_named_with_the_limit() {
    let gpu = gpu();
    let limit = gpu.properties().max_storage_buffer_range;
    for len in [limit as usize / 4 + 1, usize::MAX] {
        let error = gpu.uninit::<u32>("monster", len).unwrap_err();
        assert!(matches!(error, Error::BufferTooLarge { .. }), "{error}");
        let message = error.to_string();
        assert!(message.contains("`monster`") && message.contains(&limit.to_string()), "{message}");
    }
}

/// A binding of whole quads is up to 15 bytes longer than the elements.
#[test]
fn a_buffer_whose_binding_exceeds_the_limit_by_its_padding_is_refused() {
    let gpu = gpu_that_binds((1 << 20) + 8);
    assert!(gpu.uninit::<u32>("padded", 1 << 18).is_ok());
    let refused = gpu.uninit::<u32>("padded", (1 << 18) + 1);
    assert!(matches!(refused, Err(Error::BufferTooLarge { .. })), "{refused:?}");
}

#[test]
fn a_write_longer_than_the_buffer_is_refused_and_changes_nothing() {
    let gpu = gpu();
    let mut buffer = gpu.buffer("short", &[1u32, 2, 3]).unwrap();
    let message = gpu.write(&mut buffer, &[9; 4]).unwrap_err().to_string();
    assert!(message.contains("`short`") && message.contains('3') && message.contains('4'));
    assert_eq!(gpu.read(&buffer).unwrap(), [1, 2, 3]);
    gpu.write(&mut buffer, &[9; 2]).unwrap();
    assert_eq!(gpu.read(&buffer).unwrap(), [9, 9, 3]);
}

#[test]
fn a_buffer_dropped_in_flight_lives_until_its_work_is_done() {
    const LEN: usize = 1 << 20;
    let gpu = gpu();
    let mut result: Buffer<u32> = gpu.zeros("result", LEN).unwrap();
    let mut doomed: Buffer<u32> = gpu.uninit("doomed", LEN).unwrap();
    let submission = gpu
        .submit("in flight", |pass| {
            // Each waits for the previous one: enough time to drop the buffer too early.
            for word in 1..=50 {
                pass.fill(&mut doomed, word);
                pass.copy(&doomed, &mut result);
            }
            Ok(())
        })
        .unwrap();
    drop(doomed);
    // Memory freed too early would be reused here.
    let newcomer = gpu.buffer("newcomer", &vec![77u32; LEN]).unwrap();
    submission.wait().unwrap();
    assert!(gpu.read(&result).unwrap().iter().all(|&word| word == 50));
    assert!(gpu.read(&newcomer).unwrap().iter().all(|&word| word == 77));
}

#[test]
fn objects_dropped_by_a_failed_recording_are_safe() {
    let gpu = gpu();
    let mut kept = gpu.buffer("kept", &[1u32, 2, 3]).unwrap();
    let mut dropped: Buffer<u32> = gpu.zeros("dropped", 3).unwrap();
    let failed = gpu.run("fails", |pass| {
        pass.fill(&mut kept, 9);
        pass.copy(&kept, &mut dropped);
        drop(dropped);
        Err::<(), _>(Error::Usage("enough".to_owned()))
    });
    assert_eq!(failed.unwrap_err().to_string(), "enough");
    assert_eq!(gpu.read(&kept).unwrap(), [1, 2, 3]);
}

// ---------------------------------------------------------------------------
// Recording

#[test]
fn a_submission_is_refused_within_a_recording_and_works_after_it() {
    let gpu = gpu();
    let mut renderer = Renderer::new(&gpu, RenderSettings::default()).unwrap();
    let mut inner = gpu.buffer("inner", &[1u32, 2, 3]).unwrap();
    let mut outer: Buffer<u32> = gpu.zeros("outer", 3).unwrap();
    gpu.run("the recording", |pass| {
        let refusals = [
            gpu.write(&mut inner, &[9; 3]).unwrap_err(),
            gpu.read(&inner).unwrap_err(),
            gpu.zeros::<u32>("newcomer", 3).unwrap_err(),
            gpu.run("another", |_| Ok(())).unwrap_err(),
        ];
        for error in refusals {
            let message = error.to_string();
            says(&message, &["`the recording`", "before or after"]);
        }
        pass.copy(&inner, &mut outer);
        Ok(())
    })
    .unwrap();
    assert_eq!(gpu.read(&outer).unwrap(), [1, 2, 3]);
    renderer.reserve(100, []).unwrap();
    // A failed recording leaves no state either.
    gpu.run("fails", |_| Err::<(), _>(Error::Usage("enough".to_owned()))).unwrap_err();
    gpu.write(&mut inner, &[9; 3]).unwrap();
    assert_eq!(gpu.read(&inner).unwrap(), [9; 3]);
}

#[test]
fn another_thread_that_submits_waits_for_the_recording_to_end() {
    let gpu = gpu();
    let mut buffer: Buffer<u32> = gpu.zeros("buffer", 3).unwrap();
    let mut other: Buffer<u32> = gpu.zeros("other", 3).unwrap();
    std::thread::scope(|scope| {
        let writer = gpu.run("recording", |pass| {
            pass.fill(&mut buffer, 5);
            // It cannot be waited for here.
            let thread = scope.spawn(|| gpu.write(&mut other, &[7; 3]));
            std::thread::sleep(Duration::from_millis(20));
            assert!(!thread.is_finished());
            drop(thread);
            Ok(())
        });
        writer.unwrap();
    });
    assert_eq!(gpu.read(&buffer).unwrap(), [5; 3]);
    assert_eq!(gpu.read(&other).unwrap(), [7; 3]);
}

#[test]
fn a_download_that_was_not_submitted_is_not_waited_for() {
    let gpu = gpu();
    let buffer = gpu.buffer("buffer", &[1u32, 2, 3]).unwrap();
    let mut kept = None;
    gpu.run("too early", |pass| {
        let message = pass.download(&buffer)?.wait().unwrap_err().to_string();
        assert!(message.contains("`Gpu::run`"), "{message}");
        kept = Some(pass.download(&buffer)?);
        Ok(())
    })
    .unwrap();
    assert_eq!(kept.unwrap().wait().unwrap(), [1, 2, 3]);
}

// ---------------------------------------------------------------------------
// Launching

#[test]
fn a_dispatch_runs_on_the_requested_number_of_threads() {
    for count in [1, WORKGROUP - 1, WORKGROUP, WORKGROUP + 1, 10_007] {
        let left = ones_and_zeros(count, Threads::Exactly([count as u32, 1, 1]));
        assert_eq!(left, vec![0.0; count]);
    }
}

#[test]
fn workgroups_beyond_the_limit_along_x_are_folded_and_none_is_lost() {
    // Tiles of one subgroup without splats, since a workgroup then costs almost nothing.
    const COLUMNS: u32 = 9;
    const ROWS: u32 = 5;
    let gpu = gpu_with(|properties| properties.max_workgroups = 7);
    let lanes = gpu.properties().subgroup_size;
    let size = UVec2::new(lanes * COLUMNS, ROWS);
    let constants = blend_forward::Constants {
        channels: 3,
        tile_width: lanes,
        tile_height: 1,
        ..blend_forward::Constants::default()
    };
    let pipeline = gpu.pipeline::<blend_forward::Kernel>(&constants).unwrap();
    let params = blend_forward::Params {
        size,
        tile_columns: COLUMNS,
        longest_run: u32::MAX,
        has_limits: 0,
        depth_kind: 0,
        background: [0.25, 0.5, 0.75],
    };
    let pixels = size.element_product() as usize;
    let mut tile_ranges = gpu.zeros("tile_ranges", (ROWS * COLUMNS) as usize).unwrap();
    let (counts, sorted_tiles) =
        (gpu.zeros("counts", 1).unwrap(), gpu.zeros("sorted_tiles", 0).unwrap());
    let mut status = gpu.zeros("status", 3).unwrap();
    let (sorted_intersections, gaussian_ids) =
        (gpu.zeros("sorted_intersections", 0).unwrap(), gpu.zeros("gaussian_ids", 0).unwrap());
    let (splats, colors) = (gpu.zeros("splats", 0).unwrap(), gpu.zeros("colors", 0).unwrap());
    let mut render = gpu.zeros("render", 3 * pixels).unwrap();
    let mut transmittances = gpu.zeros("transmittances", pixels).unwrap();
    let limits = gpu.zeros("limits", 1).unwrap();
    let mut segment_states = gpu.zeros("segment_states", 1).unwrap();
    gpu.run("fold", |pass| {
        let buffers = blend_forward::Buffers {
            counts: counts.slice(),
            sorted_tiles: sorted_tiles.slice(),
            tile_ranges: tile_ranges.slice_mut(),
            status: status.slice_mut(),
            sorted_intersections: sorted_intersections.slice(),
            gaussian_ids: gaussian_ids.slice(),
            splats: splats.slice(),
            colors: colors.slice(),
            render: render.slice_mut(),
            transmittances: transmittances.slice_mut(),
            limits: limits.slice(),
            segment_states: segment_states.slice_mut(),
        };
        pass.dispatch(&pipeline, &params, buffers, Threads::Workgroups([ROWS * COLUMNS, 1, 1]))
    })
    .unwrap();
    let render = gpu.read(&render).unwrap();
    for (plane, value) in render.chunks(pixels).zip([0.25, 0.5, 0.75]) {
        assert_eq!(plane.iter().position(|&pixel| pixel != value), None);
    }
}

#[test]
fn workgroups_that_cannot_be_folded_are_refused_with_the_name_of_the_pass() {
    let gpu = gpu();
    let too_many = gpu.properties().max_workgroups + 1;
    let mut gradient = gpu.zeros("gradient", 1).unwrap();
    let activations = gpu.zeros("activations", 1).unwrap();
    let pipeline = relu_pipeline();
    let refused = gpu.run("refused", |pass| {
        let buffers = relu_backward::Buffers {
            activations: activations.slice(),
            gradient: gradient.slice_mut(),
        };
        let params = relu_backward::Params { value_count: 1 };
        pass.dispatch(&pipeline, &params, buffers, Threads::Workgroups([too_many, 2, 1]))
    });
    let message = refused.unwrap_err().to_string();
    says(&message, &["relu_backward", "workgroups"]);
}

#[test]
fn a_profile_names_each_pass_and_its_time_in_order() {
    let gpu = gpu();
    let (mut a, mut b) = (gpu.zeros("a", 5000).unwrap(), gpu.zeros("b", 5000).unwrap());
    let pipeline = relu_pipeline();
    let params = relu_backward::Params { value_count: 5000 };
    let threads = Threads::Exactly([5000, 1, 1]);
    let mut record = |pass: &mut Recorder<'_>| {
        let buffers = relu_backward::Buffers { activations: a.slice(), gradient: b.slice_mut() };
        pass.dispatch(&pipeline, &params, buffers, threads)?;
        let buffers = relu_backward::Buffers { activations: b.slice(), gradient: a.slice_mut() };
        pass.dispatch(&pipeline, &params, buffers, threads)
    };
    let times = gpu.profile("two passes", &mut record).unwrap();
    let names: Vec<_> = times.iter().map(|time| time.name).collect();
    assert_eq!(names, ["relu_backward", "relu_backward"]);
    let total: f64 = times.iter().map(|time| time.milliseconds).sum();
    assert!(times.iter().all(|time| time.milliseconds >= 0.0) && total > 0.0 && total < 10_000.0);
    let whole = gpu.profile_whole("two passes", &mut record).unwrap();
    assert!(whole > 0.0 && whole < 10_000.0, "{whole}");
}
