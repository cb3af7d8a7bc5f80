//! `metrics.jsonl`: one JSON object per iteration, flat, with the names TensorBoard shows.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::path::Path;

use super::tensorboard::EventWriter;
use crate::files;

/// File name of the metrics in the folder of a run.
pub const FILE: &str = "metrics.jsonl";

/// Where an iteration's numbers go.
#[derive(Debug)]
pub struct Metrics {
    lines: File,
    events: EventWriter,
}

impl Metrics {
    /// Opens the logs of a run that has done `iterations` iterations and `steps` steps. Lines of later iterations, which a run left
    /// behind that was killed after its last checkpoint, are removed: they will be written again.
    pub fn open(folder: &Path, iterations: u64, steps: u64) -> io::Result<Self> {
        let path = folder.join(FILE);
        if path.exists() {
            let kept: Vec<String> = BufReader::new(File::open(&path)?)
                .split(b'\n')
                .map_while(Result::ok)
                .filter_map(|line| String::from_utf8(line).ok())
                .filter(|line| {
                    let value = serde_json::from_str::<serde_json::Value>(line).unwrap_or_default();
                    value.get("iteration").and_then(serde_json::Value::as_u64).is_some_and(|i| i <= iterations)
                })
                .collect();
            let text: String = kept.into_iter().flat_map(|line| [line, "\n".into()]).collect();
            files::replace(&path, text.as_bytes())?;
        }
        let lines = OpenOptions::new().create(true).append(true).open(path)?;
        Ok(Self { lines, events: EventWriter::create(folder, steps)? })
    }

    /// Writes one iteration. Numbers that are not finite become null.
    pub fn write(&mut self, iteration: u64, steps: u64, scalars: &[(String, f64)]) -> io::Result<()> {
        let mut object = serde_json::Map::new();
        object.insert("iteration".into(), iteration.into());
        object.insert("global_step".into(), steps.into());
        for (name, value) in scalars {
            object.insert(name.clone(), (*value).into());
        }
        // One write a line, so that a kill leaves whole lines but for the last.
        self.lines.write_all(format!("{}\n", serde_json::Value::Object(object)).as_bytes())?;
        self.events.scalars(steps, scalars)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reopening_drops_what_was_written_after_the_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(folder.path(), 0, 0).unwrap();
        for i in 1..=3 {
            metrics.write(i, i * 10, &[("charts/x".into(), i as f64), ("bad".into(), f64::NAN)]).unwrap();
        }
        // Half a line, as a kill in the middle of a write would leave it.
        metrics.lines.write_all(b"{\"iteration\":4,\"glo").unwrap();
        drop(metrics);
        let mut metrics = Metrics::open(folder.path(), 2, 20).unwrap();
        metrics.write(3, 30, &[("charts/x".into(), 33.0)]).unwrap();
        let text = std::fs::read_to_string(folder.path().join(FILE)).unwrap();
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert!(lines[1].contains("\"iteration\":2") && lines[1].contains("\"bad\":null"), "{text}");
        assert!(lines[2].contains("33.0"), "{text}");
    }
}
