//! Files and folders by path, on the disk or in a ZIP archive within the path: `scan.zip/images/1.png`.
//!
//! An archive is read in place: nothing is extracted to disk, so its names cannot escape.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::io::{self, Cursor, Read, Seek};
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::SystemTime;

use nightsplat_core::{Error, Result, input};
use zip::ZipArchive;

/// Limits of an archive, bytes.
#[derive(Clone, Copy)]
struct Limits {
    /// Of an entry, decompressed.
    entry: u64,
    /// Of all entries, decompressed.
    all: u64,
    /// Of the paths of all entries and their folders, which are kept in memory.
    paths: usize,
}

const LIMITS: Limits = Limits { entry: 1 << 31, all: 1 << 37, paths: 1 << 26 };
/// The longest name of an entry, bytes, and its most folders.
const LONGEST_NAME: usize = 1024;
const MOST_LEVELS: usize = 32;

/// An open file, on disk or in memory.
pub trait ReadSeek: Read + Seek + Send {}
impl<T: Read + Seek + Send> ReadSeek for T {}

/// Whether a path is a file.
pub fn is_file(path: &Path) -> bool {
    match archived(path) {
        Some((archive, entry)) => archive.entries.contains_key(&entry),
        None => path.is_file(),
    }
}

/// Whether a path is a folder; an archive is one.
pub fn is_dir(path: &Path) -> bool {
    match archived(path) {
        Some((archive, entry)) => archive.folders.contains_key(&entry),
        None => path.is_dir(),
    }
}

/// The paths of the entries of a folder, in any order.
pub fn entries(folder: &Path) -> io::Result<Vec<PathBuf>> {
    match archived(folder) {
        Some((archive, entry)) => {
            let names = archive.folders.get(&entry).ok_or(io::ErrorKind::NotFound)?;
            Ok(names.iter().map(|name| folder.join(name)).collect())
        }
        None => std::fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.path())).collect(),
    }
}

/// The length of a file, and its modification time.
pub fn metadata(path: &Path) -> io::Result<(u64, Option<SystemTime>)> {
    match archived(path) {
        Some((archive, entry)) => {
            let (_, length) = archive.entries.get(&entry).ok_or(io::ErrorKind::NotFound)?;
            Ok((*length, archive.changed))
        }
        None => path.metadata().map(|there| (there.len(), there.modified().ok())),
    }
}

/// Opens a file.
pub fn open(path: &Path) -> io::Result<Box<dyn ReadSeek>> {
    match archived(path) {
        Some((archive, entry)) => Ok(Box::new(Cursor::new(archive.read(&entry, u64::MAX)?))),
        None => Ok(Box::new(File::open(path)?)),
    }
}

/// The bytes of a file.
pub fn bytes(path: &Path) -> Result<Vec<u8>> {
    let cannot = |error: io::Error| input::unreadable(path, &error);
    match archived(path) {
        Some((archive, entry)) => archive.read(&entry, u64::MAX).map_err(cannot),
        None => input::bytes(path),
    }
}

/// The text of a file, in the encodings of [`input::text`].
pub fn text(path: &Path) -> Result<String> {
    input::decoded(path, &bytes(path)?)
}

/// Opens a file for its header: of an entry of an archive, its first `most` bytes; `None` for what is not read twice,
/// such as a pipe.
pub fn open_header(path: &Path, most: u64) -> Option<io::Result<Box<dyn ReadSeek>>> {
    match archived(path) {
        Some((archive, entry)) => {
            Some(archive.read(&entry, most).map(|start| Box::new(Cursor::new(start)) as _))
        }
        None => path.is_file().then(|| Ok(Box::new(File::open(path)?) as _)),
    }
}

/// The archive that a path leads to or into.
pub fn archive_of(path: &Path) -> Option<&Path> {
    let is_archive = |path: &&Path| {
        path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("zip")) && path.is_file()
    };
    path.ancestors().find(is_archive)
}

/// Checks a path that names an archive.
pub fn check(path: &Path) -> io::Result<()> {
    archive_of(path).map_or(Ok(()), |path| Archive::open(path, LIMITS).map(drop))
}

/// Checks, before any work, that a file or a folder can be created.
pub fn check_writable(path: &Path) -> Result<()> {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let parent = absolute.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    // A file is replaced within its folder; a device or a pipe is written to.
    let folder =
        if parent.is_file() && parent == absolute { parent.parent() } else { Some(parent) };
    let written = match folder {
        Some(folder) if parent == absolute && !folder.is_dir() => Ok(()),
        Some(folder) => tempfile::tempfile_in(folder).map(drop),
        None => Ok(()),
    };
    written.map_err(|error| {
        Error::output(path, format!("cannot be written ({error}); choose another place"))
    })
}

/// An archive's folders and files, by path with slashes; the root is "".
struct Archive {
    zip: Mutex<ZipArchive<File>>,
    /// Index and length.
    entries: HashMap<String, (usize, u64)>,
    folders: BTreeMap<String, BTreeSet<String>>,
    changed: Option<SystemTime>,
}

impl Archive {
    fn open(path: &Path, limits: Limits) -> io::Result<Self> {
        let file = File::open(path)?;
        let changed = file.metadata()?.modified().ok();
        let mut zip = ZipArchive::new(file).map_err(io::Error::other)?;
        let mut entries = HashMap::new();
        let mut folders = BTreeMap::from([(String::new(), BTreeSet::new())]);
        let (mut expanded, mut paths) = (0_u64, 0);
        for index in 0..zip.len() {
            let entry = zip.by_index_raw(index).map_err(io::Error::other)?;
            let levels = entry.name_raw().iter().filter(|&&byte| byte == b'/').count();
            if entry.name_raw().len() > LONGEST_NAME || levels > MOST_LEVELS {
                return Err(io::Error::other(format!(
                    "a name in it has more than {LONGEST_NAME} bytes or {MOST_LEVELS} folders; pack it again"
                )));
            }
            // Names that lead out of the archive are ignored.
            let Some(name) = entry.enclosed_name().and_then(|name| slashed(&name)) else {
                continue;
            };
            expanded = expanded.saturating_add(entry.size());
            if entry.size() > limits.entry || expanded > limits.all {
                return Err(io::Error::other(format!(
                    "it expands to more than the limit for archives ({} GiB per file, {} GiB in all); extract it first",
                    limits.entry >> 30,
                    limits.all >> 30
                )));
            }
            let is_folder = entry.is_dir();
            paths += enter(&mut folders, &name);
            if paths > limits.paths {
                return Err(io::Error::other(format!(
                    "the paths in it take more than {} MiB of memory; extract it first",
                    limits.paths >> 20
                )));
            }
            if is_folder {
                folders.entry(name).or_default();
            } else {
                entries.insert(name, (index, entry.size()));
            }
        }
        Ok(Self { zip: Mutex::new(zip), entries, folders, changed })
    }

    /// The decompressed bytes of an entry, at most `most`.
    fn read(&self, entry: &str, most: u64) -> io::Result<Vec<u8>> {
        let &(index, length) = self.entries.get(entry).ok_or(io::ErrorKind::NotFound)?;
        let mut zip = self.zip.lock().unwrap_or_else(PoisonError::into_inner);
        let entry = zip.by_index(index).map_err(io::Error::other)?;
        let mut bytes = vec![];
        // It may expand to more than it declares.
        entry.take(length.min(most)).read_to_end(&mut bytes)?;
        Ok(bytes)
    }
}

/// Enters a path into its folders; returns about how many bytes that takes.
fn enter(folders: &mut BTreeMap<String, BTreeSet<String>>, path: &str) -> usize {
    /// Of a string in a tree, besides its characters.
    const STRING: usize = 64;
    let (mut child, mut taken) = (path, STRING + path.len());
    while !child.is_empty() {
        let (folder, name) = child.rsplit_once('/').unwrap_or(("", child));
        if !folders.entry(folder.to_owned()).or_default().insert(name.to_owned()) {
            break;
        }
        taken += 2 * STRING + folder.len() + name.len();
        child = folder;
    }
    taken
}

/// A path within an archive with slashes; `None` if it leads out.
fn slashed(path: &Path) -> Option<String> {
    let mut parts = vec![];
    for part in path.components() {
        match part {
            Component::Normal(part) => parts.push(part.to_str()?),
            Component::CurDir => {}
            Component::ParentDir => drop(parts.pop()?),
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(parts.join("/"))
}

/// The archive of a path, which is opened again when it changes, and the path within it.
fn archived(path: &Path) -> Option<(Arc<Archive>, String)> {
    static OPENED: LazyLock<Mutex<HashMap<PathBuf, Arc<Archive>>>> = LazyLock::new(Mutex::default);
    let at = archive_of(path)?;
    let entry = slashed(path.strip_prefix(at).ok()?)?;
    let changed = at.metadata().ok()?.modified().ok();
    let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(archive) = opened.get(at).filter(|archive| archive.changed == changed) {
        return Some((archive.clone(), entry));
    }
    let archive = Arc::new(Archive::open(at, LIMITS).ok()?);
    opened.insert(at.to_owned(), archive.clone());
    Some((archive, entry))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zip::CompressionMethod;
    use zip::write::{SimpleFileOptions, ZipWriter};

    use super::*;

    fn archive(folder: &Path, files: &[(&str, &[u8])]) -> PathBuf {
        let path = folder.join("set.zip");
        let mut zip = ZipWriter::new(File::create(&path).unwrap());
        let packed = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        for (name, bytes) in files {
            zip.start_file(*name, packed).unwrap();
            zip.write_all(bytes).unwrap();
        }
        zip.finish().unwrap();
        path
    }

    #[test]
    fn an_archive_is_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let zip = archive(folder.path(), &[("a/b/1.txt", b"one"), ("2.txt", &[7; 4000])]);
        assert!(is_dir(&zip) && is_dir(&zip.join("a")) && is_dir(&zip.join("a/b")));
        assert!(!is_dir(&zip.join("c")) && !is_dir(&zip.join("2.txt")) && !is_file(&zip));
        assert!(is_file(&zip.join("2.txt")) && is_file(&zip.join("a/./b/../b/1.txt")));
        let mut names = entries(&zip).unwrap();
        names.sort();
        assert_eq!(names, [zip.join("2.txt"), zip.join("a")]);
        assert_eq!(metadata(&zip.join("2.txt")).unwrap().0, 4000);
        assert_eq!(bytes(&zip.join("2.txt")).unwrap(), [7; 4000]);
        let mut text = String::new();
        open(&zip.join("a/b/1.txt")).unwrap().read_to_string(&mut text).unwrap();
        assert_eq!(text, "one");
        assert!(open(&zip.join("a/absent")).is_err() && entries(&zip.join("c")).is_err());
    }

    #[test]
    fn no_path_leads_out_of_an_archive() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("secret"), "s").unwrap();
        let zip = archive(folder.path(), &[("../secret", b"x"), ("/etc/x", b"x"), ("a", b"y")]);
        assert_eq!(entries(&zip).unwrap().len(), 2, "a and etc");
        assert!(!is_file(&zip.join("../secret")) || !is_file(&zip.join("a/../../secret")));
        assert_eq!(slashed(Path::new("a/../../b")), None);
    }

    #[test]
    fn an_archive_that_declares_too_large_a_size_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let zip = archive(folder.path(), &[("a", &[0; 60_000]), ("b", &[0; 60_000])]);
        let limits = |entry, all| Limits { entry, all, ..LIMITS };
        assert!(Archive::open(&zip, limits(60_000, 120_000)).is_ok());
        for limits in [limits(59_999, 1 << 20), limits(60_000, 119_999)] {
            let error = Archive::open(&zip, limits).err().unwrap().to_string();
            assert!(error.contains("extract it first"), "{error}");
        }
    }

    #[test]
    fn an_archive_with_names_of_many_folders_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let zip = archive(folder.path(), &[(&("a/".repeat(32) + "x"), b"")]);
        check(&zip).unwrap();
        for name in ["a/".repeat(33) + "x", "a".repeat(1025)] {
            let zip = archive(folder.path(), &[(&name, b"")]);
            let error = check(&zip).unwrap_err().to_string();
            assert!(error.contains("more than 1024 bytes or 32 folders"), "{error}");
        }
    }

    #[test]
    fn an_archive_whose_paths_take_much_memory_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let deep = |at: usize| format!("{at}/{}x", "folder/".repeat(30));
        let names: Vec<String> = (0..9).map(deep).collect();
        let files: Vec<(&str, &[u8])> =
            names.iter().map(|name| (name.as_str(), &b""[..])).collect();
        let zip = archive(folder.path(), &files);
        check(&zip).unwrap();
        let limits = Limits { paths: 1 << 15, ..LIMITS };
        let error = Archive::open(&zip, limits).err().unwrap().to_string();
        assert!(error.contains("paths in it take more than"), "{error}");
        archive(folder.path(), &files[..1]);
        assert!(Archive::open(&zip, limits).is_ok());
    }

    #[test]
    fn a_changed_archive_is_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let zip = archive(folder.path(), &[("a", b"old")]);
        assert!(is_file(&zip.join("a")));
        archive(folder.path(), &[("b", b"new")]);
        File::options()
            .append(true)
            .open(&zip)
            .unwrap()
            .set_modified(SystemTime::UNIX_EPOCH)
            .unwrap();
        assert!(is_file(&zip.join("b")) && !is_file(&zip.join("a")));
        std::fs::write(&zip, "no archive").unwrap();
        assert!(check(&zip).is_err());
    }
}
