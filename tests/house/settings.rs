//! The page of settings is the table of settings.

use std::path::Path;

use nightsplat::train::reference;

#[test]
fn the_page_of_settings_is_generated_from_their_table() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/settings.md");
    let (page, made) = (std::fs::read_to_string(&path).unwrap_or_default(), reference().unwrap());
    if page != made {
        let made_path = std::env::temp_dir().join("settings.md");
        std::fs::write(&made_path, &made).unwrap();
        panic!(
            "{} is another page than the table makes; copy {} there",
            path.display(),
            made_path.display()
        );
    }
}
