//! A frozen policy as files: the image, its manifest, and the metrics of its run.

use std::path::Path;

use anyhow::{Context, Result};
use composer_shared::policy::Policy;
use serde::{Deserialize, Serialize};

use super::measured::Measured;
use crate::files::write_whole;
use crate::freeze::Parity;
use crate::run::RunConfig;
use crate::run_folder::wall_seconds;

/// What is written beside an image: where it comes from and what it can do.
#[derive(Serialize, Deserialize)]
pub struct Manifest {
    task: String,
    image_bytes: usize,
    /// Digest of the task's settings, as the image has it.
    task_digest: String,
    crc32: String,
    /// Version control's name of the state that trained or at least froze it; "unknown" outside a repository.
    commit: String,
    trained_with_faults: bool,
    /// Wall time of the run, since it was started or last resumed, on the machine that trained it, s.
    wall_seconds: f64,
    parity: Parity,
    measured: Vec<Measured>,
    /// The same of all seeds that it was chosen from, if it was: that of the median success.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    seeds: Vec<SeedRows>,
    run: RunConfig,
}

impl Manifest {
    /// That of an image.
    pub fn read(image: &Path) -> Result<Self> {
        let path = image.with_extension("toml");
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        toml::from_str(&text)
            .map_err(|e| anyhow::anyhow!("{} is no manifest of this version: {}", path.display(), e.message()))
    }

    /// Puts new rows of a seed into the place of those of before, and into that of the image's own if it is the image's.
    pub fn measured_anew(&mut self, seed: u64, measured: &[Measured]) {
        if self.run.train.seed == seed {
            self.measured = measured.to_vec();
        }
        let rows = self.seeds.iter_mut().filter(|rows| rows.seed == seed);
        rows.for_each(|rows| rows.measured = measured.to_vec());
    }

    /// Writes it beside its image.
    pub fn write(&self, image: &Path) -> Result<()> {
        write_whole(&image.with_extension("toml"), toml::to_string(self)?.as_bytes())
    }
}

/// What a policy of one of several seeds can do.
#[derive(Clone, Serialize, Deserialize)]
pub struct SeedRows {
    /// Seed of the run.
    pub seed: u64,
    /// Its rows.
    pub measured: Vec<Measured>,
}

/// A frozen policy with what is known of it.
pub struct Exported<'a> {
    /// The settings of its run.
    pub config: RunConfig,
    /// Folder of the run.
    pub run: &'a Path,
    /// The image.
    pub image: &'a [u8],
    /// Floats against integers.
    pub parity: Parity,
    /// Its rows.
    pub measured: Vec<Measured>,
    /// Those of all seeds that it was chosen from.
    pub seeds: Vec<SeedRows>,
}

impl Exported<'_> {
    /// Writes image, manifest and metrics side by side.
    pub fn write(self, out: &Path, metrics: &[u8]) -> Result<()> {
        let policy = Policy::parse(self.image).map_err(|e| anyhow::anyhow!("{e}"))?;
        let manifest = Manifest {
            task: policy.task().name().into(),
            image_bytes: self.image.len(),
            task_digest: format!("{:08x}", policy.task_digest()),
            crc32: format!("{:08x}", policy.crc()),
            commit: commit(),
            trained_with_faults: policy.trained_with_faults(),
            wall_seconds: wall_seconds(self.run),
            parity: self.parity,
            measured: self.measured,
            seeds: self.seeds,
            run: self.config,
        };
        write_whole(out, self.image)?;
        manifest.write(out)?;
        write_whole(&out.with_extension("metrics.jsonl"), metrics)
    }
}

fn commit() -> String {
    let output =
        std::process::Command::new("git").args(["rev-parse", "HEAD"]).stderr(std::process::Stdio::null()).output();
    match output {
        Ok(output) if output.status.success() => String::from_utf8_lossy(&output.stdout).trim().to_string(),
        _ => "unknown".into(),
    }
}
