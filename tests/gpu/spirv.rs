//! What every compiled kernel must be, whichever compiler made it.

use std::fs;
use std::path::Path;

/// In SPIR-V 1.6, a kernel that asks for no subgroup size may be run at any that the device has; before, at the one
/// that the device reports, on which the sizes of our workgroups rest.
#[test]
fn every_kernel_is_spirv_1_5() {
    let modules: Vec<_> = fs::read_dir(Path::new(env!("OUT_DIR")))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "spv"))
        .collect();
    assert!(modules.len() > 50, "{modules:?}");
    for path in modules {
        let bytes = fs::read(&path).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[4 * at..4 * at + 4].try_into().unwrap());
        assert_eq!((word(0), word(1)), (0x0723_0203, 0x0001_0500), "{}", path.display());
    }
}
