//! Files that are whole or not there: written beside their place, synced, then renamed.

use std::io::Write;
use std::path::Path;

use anyhow::{Context, Result};

/// Writes a file so that a kill, a full disk or a crash leaves either the old content or the new, never a part.
pub fn write_whole(path: &Path, content: &[u8]) -> Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let attempt = || -> std::io::Result<()> {
        let mut file = tempfile::Builder::new().prefix(".new-").tempfile_in(folder)?;
        file.write_all(content)?;
        // A temporary file is private; what ships is as readable as any other file.
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            file.as_file().set_permissions(std::fs::Permissions::from_mode(0o644))?;
        }
        file.as_file().sync_all()?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    };
    attempt().with_context(|| {
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
}
