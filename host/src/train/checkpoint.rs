//! The checkpoint: one file with all that a run needs to go on bit for bit.
//!
//! Layout, little-endian: magic `CMPSRCK3`, then the fields of [`Checkpoint`] and of its state in order (lists and texts after
//! their length as u64), then the CRC-32 of everything before.
//! A new one is written beside the old one, made durable and renamed, so that there is a whole one at every moment.

use std::fs;
use std::io;
use std::path::Path;

use composer_shared::CRC_32;
use thiserror::Error;

use crate::files;
use crate::methods::on_policy::collect::ACTIONS;
use crate::methods::{EpisodeState, LearnerState, State};

/// File name of the checkpoint in the folder of a run.
pub const FILE: &str = "checkpoint.bin";

const MAGIC: &[u8; 8] = b"CMPSRCK3";
/// How the magic numbers of all versions begin.
const FAMILY: &[u8] = b"CMPSRCK";

/// Why a checkpoint was not read or written.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// No such file.
    #[error("{0} holds no checkpoint to resume from ({FILE} is missing)")]
    Missing(String),
    /// The file could not be read.
    #[error("the checkpoint {0} cannot be read: {1}")]
    Read(String, io::Error),
    /// Not a checkpoint.
    #[error("{0} is no training checkpoint of this program (it does not start with CMPSRCK3)")]
    Magic(String),
    /// Of another version.
    #[error(
        "the checkpoint {0} was written by another version of this program; only that version can go on with it. Its policy (network.json) can still be used"
    )]
    Version(String),
    /// Damaged.
    #[error("the checkpoint {0} is damaged (its checksum is wrong); it cannot be resumed from")]
    Damaged(String),
    /// The file could not be written.
    #[error(
        "no checkpoint can be written to {0}: {1}. Training stops here. If the folder held a checkpoint, it is untouched: make room, then go on with --resume"
    )]
    Write(String, io::Error),
}

/// The state of a run between two iterations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// The settings, as TOML.
    pub config: String,
    /// What the run trains for: robot and task, in the caller's words.
    pub fingerprint: String,
    /// What the method has learnt and where its episodes are.
    pub state: State,
}

impl Checkpoint {
    fn encode(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        let number = |out: &mut Vec<u8>, n: u64| out.extend_from_slice(&n.to_le_bytes());
        for text in [&self.config, &self.fingerprint] {
            number(&mut out, text.len() as u64);
            out.extend_from_slice(text.as_bytes());
        }
        number(&mut out, self.state.iteration);
        number(&mut out, self.state.learners.len() as u64);
        for learner in &self.state.learners {
            learner.adam_steps.iter().for_each(|steps| number(&mut out, *steps));
            for parameters in &learner.parameters {
                number(&mut out, parameters.len() as u64);
                parameters.iter().for_each(|p| out.extend_from_slice(&p.to_le_bytes()));
            }
            learner.value_norm.iter().for_each(|n| out.extend_from_slice(&n.to_le_bytes()));
            out.extend_from_slice(&learner.learning_rate.to_le_bytes());
        }
        number(&mut out, self.state.statistics.len() as u64);
        self.state.statistics.iter().for_each(|s| out.extend_from_slice(&s.to_le_bytes()));
        number(&mut out, self.state.episodes.len() as u64);
        for episode in &self.state.episodes {
            number(&mut out, episode.number);
            number(&mut out, episode.actions.len() as u64);
            episode.actions.as_flattened().iter().for_each(|a| out.extend_from_slice(&a.to_le_bytes()));
        }
        // Nothing where there is no replay buffer.
        if !self.state.replay.is_empty() {
            number(&mut out, self.state.replay.len() as u64);
            self.state.replay.iter().for_each(|x| out.extend_from_slice(&x.to_le_bytes()));
        }
        out.extend_from_slice(&CRC_32.checksum(&out).to_le_bytes());
        out
    }

    /// None if a length does not fit: with a right checksum that happens only to a file of another program.
    fn decode(body: &[u8]) -> Option<Self> {
        let mut reader = Reader(body);
        let (config, fingerprint) = (reader.text()?, reader.text()?);
        let mut state = State { iteration: reader.number()?, ..State::default() };
        for _ in 0..reader.length(16)? {
            let mut learner = LearnerState { adam_steps: [reader.number()?, reader.number()?], ..Default::default() };
            for parameters in &mut learner.parameters {
                *parameters = reader.floats(1)?;
            }
            for number in &mut learner.value_norm {
                *number = f64::from_bits(reader.number()?);
            }
            learner.learning_rate = reader.float()?;
            state.learners.push(learner);
        }
        let count = reader.length(8)?;
        state.statistics = (0..count).map(|_| reader.number().map(f64::from_bits)).collect::<Option<_>>()?;
        let count = reader.length(16)?;
        for _ in 0..count {
            let number = reader.number()?;
            let actions =
                reader.floats(ACTIONS)?.chunks_exact(ACTIONS).map(|pair| std::array::from_fn(|i| pair[i])).collect();
            state.episodes.push(EpisodeState { number, actions });
        }
        if !reader.0.is_empty() {
            state.replay = reader.floats(1)?;
        }
        reader.0.is_empty().then_some(Self { config, fingerprint, state })
    }

    /// Reads the checkpoint of a run.
    pub fn read(folder: &Path) -> Result<Self, CheckpointError> {
        let path = folder.join(FILE);
        let name = path.display().to_string();
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Err(CheckpointError::Missing(folder.display().to_string()));
            }
            Err(error) => return Err(CheckpointError::Read(name, error)),
        };
        let Some(body) = bytes.strip_prefix(MAGIC) else {
            return Err(if bytes.starts_with(FAMILY) {
                CheckpointError::Version(name)
            } else {
                CheckpointError::Magic(name)
            });
        };
        let Some((body, checksum)) = body.split_last_chunk::<4>() else { return Err(CheckpointError::Damaged(name)) };
        if CRC_32.checksum(&bytes[..bytes.len() - 4]) != u32::from_le_bytes(*checksum) {
            return Err(CheckpointError::Damaged(name));
        }
        Self::decode(body).ok_or(CheckpointError::Damaged(name))
    }

    /// Writes the checkpoint of a run. If that fails, the one before it is still there.
    pub fn write(&self, folder: &Path) -> Result<(), CheckpointError> {
        files::replace(&folder.join(FILE), &self.encode())
            .map_err(|error| CheckpointError::Write(folder.display().to_string(), error))
    }
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn number(&mut self) -> Option<u64> {
        let (bytes, rest) = self.0.split_first_chunk::<8>()?;
        self.0 = rest;
        Some(u64::from_le_bytes(*bytes))
    }

    fn float(&mut self) -> Option<f32> {
        let (bytes, rest) = self.0.split_first_chunk::<4>()?;
        self.0 = rest;
        Some(f32::from_le_bytes(*bytes))
    }

    /// A count of things of `size` bytes each, which must still be there.
    fn length(&mut self, size: usize) -> Option<usize> {
        let count = usize::try_from(self.number()?).ok()?;
        (count.checked_mul(size)? <= self.0.len()).then_some(count)
    }

    fn take(&mut self, bytes: usize) -> Option<&[u8]> {
        let (taken, rest) = self.0.split_at_checked(bytes)?;
        self.0 = rest;
        Some(taken)
    }

    fn text(&mut self) -> Option<String> {
        let length = self.length(1)?;
        String::from_utf8(self.take(length)?.to_vec()).ok()
    }

    /// A counted list of `width` floats each.
    fn floats(&mut self, width: usize) -> Option<Vec<f32>> {
        let count = self.length(4 * width)?;
        let bytes = self.take(4 * width * count)?;
        Some(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> Checkpoint {
        Checkpoint {
            config: "seed = 1".into(),
            fingerprint: "snake".into(),
            state: State {
                iteration: 3,
                learners: [7, 9]
                    .map(|n| LearnerState {
                        adam_steps: [n, n + 1],
                        parameters: std::array::from_fn(|i| vec![0.1 * i as f32, f32::MIN_POSITIVE, -(n as f32)]),
                        value_norm: [0.1 * n as f64, -0.0, f64::MAX],
                        learning_rate: 1e-3 * n as f32,
                    })
                    .into(),
                statistics: vec![1.0 / 3.0, f64::EPSILON],
                episodes: vec![
                    EpisodeState { number: 5, actions: vec![[0.1, -7.5], [1e-30, 2.0]] },
                    EpisodeState { number: 0, actions: vec![] },
                ],
                replay: vec![1.5, f32::MAX],
            },
        }
    }

    #[test]
    fn comes_back_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        example().write(folder.path()).unwrap();
        assert_eq!(Checkpoint::read(folder.path()).unwrap(), example());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let whole = example().encode();
        let path = folder.path().join(FILE);
        for i in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[i] ^= 1 << (i % 8);
            fs::write(&path, &bytes).unwrap();
            let error = Checkpoint::read(folder.path()).unwrap_err();
            let version = i == FAMILY.len();
            assert_eq!(matches!(error, CheckpointError::Magic(_)), i < 8 && !version, "byte {i}: {error}");
            assert_eq!(matches!(error, CheckpointError::Version(_)), version, "byte {i}: {error}");
            fs::write(&path, &whole[..i]).unwrap();
            assert!(Checkpoint::read(folder.path()).is_err(), "cut to {i} bytes");
        }
    }

    #[test]
    fn one_of_an_older_version_is_refused_as_such() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FILE), b"CMPSRCK1 and whatever it held").unwrap();
        let error = Checkpoint::read(folder.path()).unwrap_err().to_string();
        assert!(error.contains("another version of this program"), "{error}");
    }

    #[test]
    fn a_missing_one_is_said_to_be_missing() {
        let folder = tempfile::tempdir().unwrap();
        let error = Checkpoint::read(folder.path()).unwrap_err().to_string();
        assert!(error.contains("holds no checkpoint"), "{error}");
    }

    #[test]
    fn a_failed_write_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let error = example().write(&folder.path().join("gone")).unwrap_err().to_string();
        assert!(error.contains("Training stops here") && error.contains("gone"), "{error}");
    }
}
