//! Files that are whole or not there: written beside their place, synced, then renamed.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use anyhow::{Context, Result};
use serde::de::DeserializeOwned;

/// Replaces a file, or makes it: a kill, a full disk or a crash leaves either the old content or the new, never a part.
pub fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".new-");
    // A temporary file is private by default; what is written here may be read by whom the umask allows.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(content)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|e| e.error)?;
    // The rename itself must reach the disk, too.
    File::open(folder)?.sync_all()
}

/// [`replace`], with a sentence that says which file could not be written.
pub fn write_whole(path: &Path, content: &[u8]) -> Result<()> {
    replace(path, content).with_context(|| {
        format!("cannot write {}; is the folder there, writable, and the disk not full?", path.display())
    })
}

/// Creates a folder and says which one if that fails.
pub fn create_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).with_context(|| format!("cannot create the folder {}", path.display()))?;
    let probe = tempfile::tempfile_in(path);
    probe.with_context(|| format!("cannot write in the folder {}", path.display()))?;
    Ok(())
}

/// The elements of a JSON file that this program publishes, each as `sound` wants it; none where there is no such file.
pub fn read_published<T: DeserializeOwned>(file: &Path, sound: impl Fn(&T) -> bool) -> Result<Vec<T>> {
    let Ok(text) = std::fs::read(file) else { return Ok(Vec::new()) };
    serde_json::from_slice(&text)
        .ok()
        .filter(|data: &Vec<T>| data.iter().all(sound))
        .with_context(|| format!("{} is not what this program publishes: delete it", file.display()))
}

/// What was published with new elements in the place of those that are of the same `part` (of a task, say), all in the `order`.
pub fn with_new<T, P: PartialEq, O: Ord>(
    mut before: Vec<T>,
    new: Vec<T>,
    part: impl Fn(&T) -> P,
    order: impl Fn(&T) -> O,
) -> Vec<T> {
    before.retain(|before| new.iter().all(|new| part(new) != part(before)));
    before.extend(new);
    before.sort_by_key(order);
    before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        write_whole(&path, b"old").unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        let error = write_whole(&folder.path().join("none/b"), b"x").unwrap_err().to_string();
        assert!(error.contains("none/b"), "{error}");
    }

    #[test]
    fn new_elements_replace_those_of_their_part_alone() {
        let before = vec![("tube", 2), ("goal", 1), ("tube", 1), ("wall", 1)];
        let all = with_new(before, vec![("tube", 7), ("goal", 4)], |one| one.0, |one| *one);
        assert_eq!(all, [("goal", 4), ("tube", 7), ("wall", 1)]);
    }
}
