//! Results that take long, kept in a file one by one: whoever is stopped goes on where he was.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::{Context, Result};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::files::write_whole;

/// Results by what they are results of.
pub struct Rows {
    path: PathBuf,
    rows: Mutex<BTreeMap<String, Value>>,
}

impl Rows {
    /// Those of a file; none if there is no such file.
    pub fn open(path: &Path) -> Result<Self> {
        let rows = match std::fs::read(path) {
            Ok(text) => serde_json::from_slice(&text)
                .with_context(|| format!("{} is damaged; without it everything is measured anew", path.display()))?,
            Err(_) => BTreeMap::new(),
        };
        Ok(Rows { path: path.into(), rows: Mutex::new(rows) })
    }

    /// The result of `key`: the one that is there, else that of `make`, which is there from then on. The key says everything that it depends on.
    pub fn get<T: Serialize + DeserializeOwned>(&self, key: &str, make: impl FnOnce() -> Result<T>) -> Result<T> {
        let known = self.rows.lock().unwrap_or_else(PoisonError::into_inner).get(key).cloned();
        if let Some(result) = known.and_then(|value| serde_json::from_value(value).ok()) {
            return Ok(result);
        }
        let result = make()?;
        let mut rows = self.rows.lock().unwrap_or_else(PoisonError::into_inner);
        rows.insert(key.into(), serde_json::to_value(&result)?);
        write_whole(&self.path, serde_json::to_string_pretty(&*rows)?.as_bytes())?;
        Ok(result)
    }

    /// The result of `key`, if it is there.
    pub fn find<T: DeserializeOwned>(&self, key: &str) -> Option<T> {
        let rows = self.rows.lock().unwrap_or_else(PoisonError::into_inner);
        rows.get(key).and_then(|value| serde_json::from_value(value.clone()).ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_measured_is_not_measured_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rows.json");
        let rows = Rows::open(&path).unwrap();
        assert_eq!(rows.get("a", || Ok(1.5)).unwrap(), 1.5);
        assert!(rows.get::<f64>("b", || anyhow::bail!("no")).is_err());
        let rows = Rows::open(&path).unwrap();
        assert_eq!(rows.get("a", || Ok(7.0)).unwrap(), 1.5);
        assert_eq!(rows.get("b", || Ok(2.5)).unwrap(), 2.5);
        assert_eq!((rows.find("b"), rows.find::<f64>("c")), (Some(2.5), None));
        std::fs::write(&path, "{").unwrap();
        assert!(Rows::open(&path).err().unwrap().to_string().contains("is damaged"));
    }
}
