//! What is refused, and memory that runs out.

use super::threads::lock_queue;
use super::*;

#[test]
fn every_bad_device_is_refused_by_code_and_name() {
    let host = Host::new(usual_extensions());
    let good = lend(&host, NSP_DEVICE_RECORD_ONLY);
    let mut device = null_mut();
    let mut refuse = |change: &dyn Fn(&mut NspHostDevice), code, words: &[&str]| {
        let mut lent = good;
        change(&mut lent);
        // SAFETY: what is wrong is refused before it is used.
        refused(unsafe { nsp_device_from_host(&lent, &mut device) }, code, words);
        assert!(device.is_null());
    };
    refuse(&|lent| lent.struct_size = 0, NSP_ERROR_USAGE, &["NspHostDevice::struct_size", "0"]);
    refuse(&|lent| lent.struct_size = 8, NSP_ERROR_VERSION, &["NspHostDevice::struct_size", "8"]);
    refuse(
        &|lent| lent.get_instance_proc_addr = None,
        NSP_ERROR_USAGE,
        &["nsp_device_from_host", "NspHostDevice::get_instance_proc_addr"],
    );
    refuse(&|lent| lent.instance = vk::Instance::null(), NSP_ERROR_USAGE, &["::instance"]);
    refuse(
        &|lent| lent.physical_device = vk::PhysicalDevice::null(),
        NSP_ERROR_USAGE,
        &["::physical_device"],
    );
    refuse(&|lent| lent.device = vk::Device::null(), NSP_ERROR_USAGE, &["::device"]);
    refuse(&|lent| lent.flags &= !NSP_DEVICE_RECORD_ONLY, NSP_ERROR_USAGE, &["::queue"]);
    refuse(&|lent| lent.lock_queue = Some(lock_queue), NSP_ERROR_USAGE, &["lock_queue", "both"]);
    refuse(&|lent| lent.extension_count = 1, NSP_ERROR_USAGE, &["::extensions"]);
    let struct_size = size_of::<NspMemoryFunctions>();
    let functions =
        NspMemoryFunctions { struct_size, allocate: None, free: None, user: null_mut() };
    refuse(&|lent| lent.device_memory = &functions, NSP_ERROR_USAGE, &["device_memory"]);
    refuse(&|lent| lent.queue_family = 7, NSP_ERROR_USAGE, &["queue_family", "7"]);
    // A chain of features without one that is needed.
    let mut vulkan13 = vk::PhysicalDeviceVulkan13Features::default().synchronization2(true);
    let mut vulkan12 = vk::PhysicalDeviceVulkan12Features::default()
        .timeline_semaphore(true)
        .scalar_block_layout(true);
    let chain =
        vk::PhysicalDeviceFeatures2::default().push_next(&mut vulkan12).push_next(&mut vulkan13);
    let features = (&raw const chain).cast();
    refuse(&|lent| lent.features = features, NSP_ERROR_DEVICE, &["subgroupSizeControl"]);
    // SAFETY: NULL is refused.
    unsafe {
        refused(nsp_device_from_host(null(), &mut null_mut()), NSP_ERROR_USAGE, &["NspHostDevice"]);
        refused(nsp_device_from_host(&good, null_mut()), NSP_ERROR_USAGE, &["device"]);
        let check = nsp_check_device(None, good.instance, good.physical_device);
        refused(check, NSP_ERROR_USAGE, &["get_instance_proc_addr"]);
        ok(nsp_check_device(good.get_instance_proc_addr, good.instance, good.physical_device));
    }
    host.destroy();
}

#[test]
fn structs_grow_by_zeros() {
    let host = Host::new(usual_extensions());
    let good = lend(&host, NSP_DEVICE_RECORD_ONLY);
    #[repr(C)]
    #[derive(Clone, Copy)]
    struct Later {
        current: NspHostDevice,
        more: [u64; 2],
    }
    let mut later = Later { current: good, more: [0; 2] };
    later.current.struct_size = size_of::<Later>();
    let mut device = null_mut();
    // SAFETY: the struct is as long as it says.
    unsafe {
        ok(nsp_device_from_host((&raw const later).cast(), &mut device));
        nsp_device_destroy(device);
        later.more[1] = 1;
        let result = nsp_device_from_host((&raw const later).cast(), &mut device);
        refused(result, NSP_ERROR_VERSION, &["NspHostDevice", "not 0"]);
    }
    host.destroy();
}

#[test]
fn every_bad_render_is_refused_by_code_and_name_and_nothing_is_recorded() {
    let session = Session::ready(|_| {});
    let (camera, color) = (c_camera(), session.image());
    let commands = session.host.begin();
    let good = render(commands, 5, &camera, &color);
    let (renderer, model) = (session.renderer, session.model);
    let refuse = |change: &dyn Fn(&mut NspRender), code, words: &[&str]| {
        let mut render = good;
        change(&mut render);
        // SAFETY: what is wrong is refused before it is used.
        refused(unsafe { nsp_record_render(renderer, model, &render) }, code, words);
    };
    // SAFETY: NULL is refused.
    unsafe {
        let null_renderer = nsp_record_render(null_mut(), model, &good);
        refused(null_renderer, NSP_ERROR_USAGE, &["nsp_record_render", "renderer is NULL"]);
        refused(nsp_record_render(renderer, null(), &good), NSP_ERROR_USAGE, &["model is NULL"]);
        refused(
            nsp_record_render(renderer, model, null()),
            NSP_ERROR_USAGE,
            &["NspRender is NULL"],
        );
    }
    refuse(&|changed| changed.struct_size = 0, NSP_ERROR_USAGE, &["NspRender::struct_size"]);
    refuse(
        &|changed| changed.commands = vk::CommandBuffer::null(),
        NSP_ERROR_USAGE,
        &["::commands"],
    );
    refuse(&|changed| changed.cameras = null(), NSP_ERROR_USAGE, &["::cameras"]);
    refuse(&|changed| changed.camera_count = 0, NSP_ERROR_USAGE, &["::cameras"]);
    refuse(&|changed| changed.flags = 1 << 20, NSP_ERROR_USAGE, &["::flags", "0x100000"]);
    refuse(
        &|changed| changed.flags = NSP_RENDER_PHOTOGRAPH,
        NSP_ERROR_USAGE,
        &["states no tone law", "named tone curve"],
    );
    let mut eyes = [camera; 2];
    // Turned by half a circle about y.
    (eyes[1].view_from_world[0], eyes[1].view_from_world[10]) = (-1.0, -1.0);
    let layered = NspImage { layers: 2, ..color };
    let one_sort = |changed: &mut NspRender| {
        (changed.cameras, changed.camera_count) = (eyes.as_ptr(), 2);
        (changed.color, changed.flags) = (&layered, NSP_RENDER_ONE_SORT);
    };
    refuse(&one_sort, NSP_ERROR_USAGE, &["beside the mean", "one sort"]);
    refuse(&|changed| changed.color = null(), NSP_ERROR_USAGE, &["no target"]);
    refuse(&|changed| changed.exposure = f32::INFINITY, NSP_ERROR_USAGE, &["exposure"]);
    let with = |change: &dyn Fn(&mut NspImage), code, words: &[&str]| {
        let mut image = color;
        change(&mut image);
        refuse(&|changed| changed.color = &image, code, words);
    };
    with(&|changed| changed.image = vk::Image::null(), NSP_ERROR_USAGE, &["color", "null"]);
    with(
        &|changed| changed.format = vk::Format::R8_UNORM,
        NSP_ERROR_USAGE,
        &["::color", "RGBA16F"],
    );
    with(&|changed| changed.extent.width = 10, NSP_ERROR_USAGE, &["color", "10x240", "320x240"]);
    refuse(&|changed| changed.depth_out = &color, NSP_ERROR_USAGE, &["depth", "R32Float"]);
    refuse(&|changed| changed.scene_depth = &color, NSP_ERROR_USAGE, &["scene depth"]);
    let with = |change: &dyn Fn(&mut NspCamera), words: &[&str]| {
        let mut other = camera;
        change(&mut other);
        refuse(&|changed| changed.cameras = &other, NSP_ERROR_USAGE, words);
    };
    with(&|changed| changed.width = 0, &["camera 0", "0x240"]);
    with(&|changed| changed.focal[1] = 0.0, &["focal"]);
    with(&|changed| changed.view_from_world[3] = f64::NAN, &["not finite"]);
    with(&|changed| changed.view_from_world[0] = 1.1, &["not rigid"]);
    // A view beyond what the device follows names the longest side it takes.
    with(&|changed| (changed.width, changed.height) = (1 << 20, 1 << 20), &["color"]);

    // Nothing was recorded: the frame's number has not moved either.
    // SAFETY: everything is valid.
    ok(unsafe { nsp_record_render(renderer, model, &NspRender { frame: 4, ..good }) });
    refuse(&|changed| changed.frame = 3, NSP_ERROR_USAGE, &["frame 3", "frame 4"]);
    session.host.submit_frame(commands, 4);
    session.host.wait_frame(4);
    assert_close(&session.pixels(), &own_render(&Model::from(gaussians(2))));
    session.end();
}

/// Appends a line of the log to the vector that `user` is.
unsafe extern "C" fn keep_line(user: *mut c_void, level: i32, line: *const c_char) {
    // SAFETY: as the test sets it; one call at a time.
    unsafe {
        let lines = &mut *user.cast::<Vec<(i32, String)>>();
        lines.push((level, CStr::from_ptr(line).to_str().unwrap().to_owned()));
    }
}

#[test]
fn every_bad_model_is_refused_by_code_and_name() {
    let mut session = Session::new(|_| {});
    let (device, folder) = (session.device, session.folder.path().to_owned());
    let mut model = null_mut();
    let mut load = |path: &Path, code, words: &[&str]| {
        // SAFETY: valid.
        let result = unsafe { nsp_model_load(device, c_path(path).as_ptr(), &mut model) };
        refused(result, code, words);
        assert!(model.is_null());
    };
    load(&folder.join("absent.ply"), NSP_ERROR_INPUT, &["absent.ply"]);
    let bytes = std::fs::read(folder.join("model.ply")).unwrap();
    std::fs::write(folder.join("cut.ply"), &bytes[..bytes.len() - 100]).unwrap();
    load(&folder.join("cut.ply"), NSP_ERROR_INPUT, &["cut.ply"]);
    let mut broken = gaussians(0);
    broken.means_mut().fill(Vec3::NAN);
    broken.save(folder.join("nan.ply")).unwrap();
    load(&folder.join("nan.ply"), NSP_ERROR_INPUT, &["nan.ply", "NaN"]);
    // A part of them is left out, which the log says.
    broken.means_mut()[1..].fill(Vec3::ZERO);
    broken.save(folder.join("part.ply")).unwrap();
    let mut lines: Vec<(i32, String)> = vec![];
    // SAFETY: valid; the log is another before `lines` ends.
    unsafe {
        nsp_set_log(Some(keep_line), (&raw mut lines).cast());
        let result = nsp_model_load(device, c_path(&folder.join("part.ply")).as_ptr(), &mut model);
        nsp_set_log(None, null_mut());
        ok(result);
        nsp_model_destroy(model);
    }
    let is_warned = |(level, line): &(i32, String)| {
        *level == 2 && line.contains("part.ply: 1 of ") && line.contains("are left out")
    };
    assert!(lines.iter().any(is_warned), "{lines:?}");
    model = null_mut();
    // SAFETY: NULL and the rest are refused.
    unsafe {
        let result = nsp_model_load(device, null(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["nsp_model_load", "path is NULL"]);
        let latin = [0xe9u8, 0];
        let result = nsp_model_load(device, latin.as_ptr().cast::<c_char>(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["path is not UTF-8"]);
        refused(nsp_model_load(null_mut(), null(), &mut model), NSP_ERROR_USAGE, &["device"]);
        let planes = [null(); 6];
        let result = nsp_model_create(device, 3, 4, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["sh_degree is 4"]);
        let result = nsp_model_create(device, 3, 0, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_USAGE, &["plane 0", "means"]);
        let nan = [f32::NAN; 16];
        let planes = [nan.as_ptr(); 6];
        let result = nsp_model_create(device, 3, 0, planes.as_ptr(), &mut model);
        refused(result, NSP_ERROR_NOT_FINITE, &["plane 0", "means"]);
        let result = nsp_model_join(device, null(), null(), 0, &mut model);
        refused(result, NSP_ERROR_USAGE, &["no models"]);
        assert_eq!(nsp_model_count(null()), 0);
    }
    // A model of another device.
    let mut other = Session::new(|_| {});
    ok(other.load());
    session.model = other.model;
    refused(session.create(), NSP_ERROR_USAGE, &["nsp_renderer_create", "another device"]);
    session.model = null_mut();
    // Training where nothing may be submitted.
    let mut trainer = null_mut();
    // SAFETY: valid.
    unsafe {
        let result = nsp_trainer_create(device, c".".as_ptr(), null(), null(), &mut trainer);
        refused(result, NSP_ERROR_USAGE, &["nsp_trainer_create", "record-only"]);
    }
    other.end();
    session.end();
}

#[test]
fn a_panic_becomes_a_code_and_leaves_the_object_to_be_destroyed() {
    let mut session = Session::ready(|_| {});
    ok(session.frame(1));
    panic_in("the renderer");
    refused(session.frame(2), NSP_ERROR_INTERNAL, &["nsp_record_render", "a bug of nightsplat"]);
    refused(session.frame(3), NSP_ERROR_INTERNAL, &["the renderer", "destroy it"]);
    // The device and the model are as they were.
    // SAFETY: valid, and its frames are done.
    unsafe { nsp_renderer_destroy(session.renderer) };
    ok(session.create());
    ok(session.frame(4));
    panic_in("nsp_model_load");
    let mut model = null_mut();
    // SAFETY: valid.
    let result = unsafe { nsp_model_load(session.device, session.path().as_ptr(), &mut model) };
    refused(result, NSP_ERROR_INTERNAL, &["nsp_model_load"]);
    session.end();
}

#[test]
fn memory_that_runs_out_anywhere_is_a_code_and_the_next_try_draws() {
    let mut session = Session::new(|_| {});
    // SAFETY: valid.
    let gpu = unsafe { &*session.device }.gpu();
    faults(&gpu).fail_allocation(0);
    session.prepare();
    ok(session.frame(1));
    let sites = faults(&gpu).allocations();
    assert!(sites.len() > 20, "{sites:?}");
    let expected = session.pixels();
    for number in 1..=sites.len() as u64 {
        let frame = 2 * number;
        session.clear();
        faults(&gpu).fail_allocation(number);
        let mut result = session.load();
        if result == NSP_OK {
            result = session.create();
        }
        if result == NSP_OK {
            result = session.frame(frame);
        }
        let site = &sites[number as usize - 1];
        assert_eq!(result, NSP_ERROR_MEMORY, "{site} ({number}): {}", last_error());
        faults(&gpu).fail_allocation(0);
        if session.model.is_null() {
            ok(session.load());
        }
        if session.renderer.is_null() {
            ok(session.create());
        }
        ok(session.frame(frame + 1));
        assert_eq!(session.pixels(), expected, "{site}");
    }
    // A device of the host's goes last.
    drop(gpu);
    session.end();
}

/// The host's allocator: counts what is out, fails on demand, or misaligns.
struct HostMemory {
    device: ash::Device,
    out: AtomicU64,
    wrong: AtomicU64,
}

unsafe extern "C" fn allocate(
    user: *mut c_void,
    requirements: *const vk::MemoryRequirements,
    _: vk::MemoryPropertyFlags,
    _: vk::MemoryPropertyFlags,
    name: *const c_char,
    out: *mut NspMemory,
) -> vk::Result {
    // SAFETY: as the library promises.
    unsafe {
        let host = &*user.cast::<HostMemory>();
        assert!(!CStr::from_ptr(name).to_bytes().is_empty());
        match host.wrong.load(Ordering::Acquire) {
            1 => return vk::Result::ERROR_OUT_OF_DEVICE_MEMORY,
            2 => {
                host.out.fetch_add(1, Ordering::AcqRel);
                (*out).offset = 3;
                return vk::Result::SUCCESS;
            }
            _ => (),
        }
        let needed = &*requirements;
        // lavapipe's one type has every property; other devices take part in the other tests.
        let info = vk::MemoryAllocateInfo::default()
            .allocation_size(needed.size)
            .memory_type_index(needed.memory_type_bits.trailing_zeros());
        let memory = host.device.allocate_memory(&info, None).unwrap();
        let mapped = host.device.map_memory(memory, 0, vk::WHOLE_SIZE, Default::default());
        *out = NspMemory { memory, offset: 0, mapped: mapped.unwrap(), cookie: null_mut() };
        host.out.fetch_add(1, Ordering::AcqRel);
        vk::Result::SUCCESS
    }
}

unsafe extern "C" fn free(user: *mut c_void, memory: *const NspMemory) {
    // SAFETY: as the library promises.
    unsafe {
        let host = &*user.cast::<HostMemory>();
        if (*memory).memory != vk::DeviceMemory::null() {
            host.device.free_memory((*memory).memory, None);
            host.out.fetch_sub(1, Ordering::AcqRel);
        } else if host.wrong.load(Ordering::Acquire) == 2 {
            host.out.fetch_sub(1, Ordering::AcqRel);
        }
    }
}

#[test]
fn the_hosts_allocator_gives_all_memory_and_gets_it_back() {
    if !gpu().properties().is_cpu {
        return not_run("lavapipe", "the host's allocator needs memory types that are all mapped");
    }
    let host_memory = OnceLock::new();
    let mut functions = NspMemoryFunctions {
        struct_size: size_of::<NspMemoryFunctions>(),
        allocate: Some(allocate),
        free: Some(free),
        user: null_mut(),
    };
    let mut session = Session::new(|lent| {
        // SAFETY: the handles are live.
        let device = unsafe {
            let get =
                ash::StaticFn { get_instance_proc_addr: lent.get_instance_proc_addr.unwrap() };
            let instance = ash::Instance::load(&get, lent.instance);
            ash::Device::load(instance.fp_v1_0(), lent.device)
        };
        let memory = HostMemory { device, out: AtomicU64::new(0), wrong: AtomicU64::new(0) };
        functions.user = (&raw const *host_memory.get_or_init(|| memory)).cast_mut().cast();
        lent.device_memory = &functions;
    });
    let host_memory = host_memory.get().unwrap();
    session.prepare();
    session.assert_draws(1, &Model::from(gaussians(2)));
    let out = host_memory.out.load(Ordering::Acquire);
    assert!(out > 20, "{out}");
    let mut model = null_mut();
    for (wrong, code, words) in
        [(1, NSP_ERROR_MEMORY, "ERROR_OUT_OF_DEVICE_MEMORY"), (2, NSP_ERROR_INTERNAL, "offset 3")]
    {
        host_memory.wrong.store(wrong, Ordering::Release);
        let device = session.device;
        // SAFETY: valid.
        let result = unsafe { nsp_model_load(device, session.path().as_ptr(), &mut model) };
        refused(result, code, &["nsp_model_load", words]);
        assert_eq!(host_memory.out.load(Ordering::Acquire), out);
    }
    host_memory.wrong.store(0, Ordering::Release);
    session.clear();
    // SAFETY: every frame is done.
    ok(unsafe { nsp_frames_done(session.device, u64::MAX) });
    assert_eq!(host_memory.out.load(Ordering::Acquire), 0);
    session.end();
}

#[test]
fn a_lost_device_is_a_code_and_everything_can_be_destroyed() {
    let mut session = Session::with_flags(0, |_| {});
    // SAFETY: valid.
    let gpu = unsafe { &*session.device }.gpu();
    let dataset = session.folder.path().join("dataset");
    write(&dataset, &SyntheticOptions { width: 24, height: 20, ..Default::default() }).unwrap();
    let dataset = c_path(&dataset);
    ok(session.load());
    faults(&gpu).lose_at_submission(5);
    let mut trainer = null_mut();
    // SAFETY: valid.
    unsafe {
        let result =
            nsp_trainer_create(session.device, dataset.as_ptr(), null(), null(), &mut trainer);
        refused(result, NSP_ERROR_LOST, &["nsp_trainer_create", "was lost"]);
        assert!(trainer.is_null());
        ok(nsp_frames_done(session.device, u64::MAX));
    }
    drop(gpu);
    session.end();
}

/// The host's allocations for Vulkan objects that are out.
static OBJECTS: AtomicU64 = AtomicU64::new(0);
/// A block's size and alignment lie before its first byte, in as many bytes as its alignment.
const PREFIX: usize = 16;

unsafe extern "system" fn allocate_object(
    _: *mut c_void,
    size: usize,
    alignment: usize,
    _: vk::SystemAllocationScope,
) -> *mut c_void {
    let alignment = alignment.max(PREFIX);
    let layout = std::alloc::Layout::from_size_align(size + alignment, alignment).unwrap();
    // SAFETY: the layout is not empty; the numbers fit before the block.
    unsafe {
        let block = std::alloc::alloc(layout).add(alignment);
        block.cast::<usize>().sub(1).write(alignment);
        block.cast::<usize>().sub(2).write(size);
        OBJECTS.fetch_add(1, Ordering::AcqRel);
        block.cast()
    }
}

unsafe extern "system" fn free_object(_: *mut c_void, block: *mut c_void) {
    if block.is_null() {
        return;
    }
    // SAFETY: of `allocate_object`.
    unsafe {
        let alignment = block.cast::<usize>().sub(1).read();
        let size = block.cast::<usize>().sub(2).read();
        let layout = std::alloc::Layout::from_size_align(size + alignment, alignment).unwrap();
        std::alloc::dealloc(block.cast::<u8>().sub(alignment), layout);
    }
    OBJECTS.fetch_sub(1, Ordering::AcqRel);
}

unsafe extern "system" fn reallocate_object(
    user: *mut c_void,
    block: *mut c_void,
    size: usize,
    alignment: usize,
    scope: vk::SystemAllocationScope,
) -> *mut c_void {
    // SAFETY: of `allocate_object`, or null.
    unsafe {
        let new = allocate_object(user, size, alignment, scope);
        if !block.is_null() {
            let old = block.cast::<usize>().sub(2).read();
            std::ptr::copy_nonoverlapping(block.cast::<u8>(), new.cast(), old.min(size));
            free_object(user, block);
        }
        new
    }
}

#[test]
fn objects_come_from_the_hosts_callbacks_and_its_pipeline_cache_stays_its_own() {
    let callbacks = vk::AllocationCallbacks::default()
        .pfn_allocation(Some(allocate_object))
        .pfn_reallocation(Some(reallocate_object))
        .pfn_free(Some(free_object));
    let (device, cache) = (OnceLock::new(), OnceLock::new());
    let mut session = Session::new(|lent| {
        lent.host_memory = &callbacks;
        let info = vk::PipelineCacheCreateInfo::default();
        // SAFETY: the handles are live.
        unsafe {
            let get = lent.get_instance_proc_addr.unwrap();
            let get = ash::StaticFn { get_instance_proc_addr: get };
            let instance = ash::Instance::load(&get, lent.instance);
            let lent_device =
                device.get_or_init(|| ash::Device::load(instance.fp_v1_0(), lent.device));
            lent.pipeline_cache = lent_device.create_pipeline_cache(&info, None).unwrap();
        }
        cache.set(lent.pipeline_cache).unwrap();
    });
    let (device, cache) = (device.get().unwrap(), *cache.get().unwrap());
    session.prepare();
    session.assert_draws(1, &Model::from(gaussians(2)));
    assert!(OBJECTS.load(Ordering::Acquire) > 10);
    session.clear();
    // SAFETY: every frame is done; the cache is still there for the host to destroy, which validation would refute.
    unsafe {
        nsp_device_destroy(std::mem::replace(&mut session.device, null_mut()));
        device.destroy_pipeline_cache(cache, None);
    }
    assert_eq!(OBJECTS.load(Ordering::Acquire), 0, "objects that are not destroyed");
    session.end();
}
