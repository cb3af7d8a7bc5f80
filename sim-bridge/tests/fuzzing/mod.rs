//! Feeds a reader inputs that are nearly right: what lies in a folder of its corpus, changed at random by a seed. Nothing that comes from outside may make a reader
//! panic, or loop for ever.
//!
//! A test runs a bounded number of inputs; `FUZZ_INPUTS=1000000000` in the environment has it run so many instead, over all its readers together, and
//! `FUZZ_SEED` another sequence of them. The `fuzz_targets` in `shared/fuzz` are for the coverage-guided fuzzer.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use composer_shared::random::SplitMix64;

/// A reader under test.
pub struct Target {
    /// Its name, and that of its folder.
    pub name: &'static str,
    /// Inputs out of a million.
    pub share: u64,
    /// What must not panic.
    pub run: fn(&[u8]),
    /// What is good for it.
    pub corpus: Vec<Vec<u8>>,
    /// Pieces of text to put in.
    pub words: &'static [&'static str],
}

/// The files of a folder, in order of their names.
pub fn corpus(folder: &Path) -> Vec<Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_file()).collect();
    files.sort();
    let files: Vec<Vec<u8>> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    assert!(!files.is_empty(), "{} is empty", folder.display());
    files
}

/// Random numbers by SplitMix64: a fuzzer spends its time elsewhere.
struct Random(SplitMix64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0.next_u64()
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }
}

/// Most bytes that an input grows to.
const LONGEST: usize = 1 << 15;

/// An input that is nearly right.
fn change(target: &Target, random: &mut Random, input: &mut Vec<u8>) {
    input.clear();
    input.extend(&target.corpus[random.below(target.corpus.len())]);
    for _ in 0..=random.below(6) {
        let at = random.below(input.len() + 1);
        match random.below(9) {
            0 if at < input.len() => input[at] ^= 1 << random.below(8),
            1 if at < input.len() => input[at] = random.next() as u8,
            2 if at < input.len() => input[at] = [0, 1, 0x7f, 0x80, 0xff, b'\n', b' ', b'9'][random.below(8)],
            3 => input.truncate(at),
            4 => {
                let length = random.below(8).min(input.len() - at);
                input.drain(at..at + length);
            }
            5 => input.insert(at, random.next() as u8),
            6 => {
                let length = random.below(16).min(input.len() - at);
                let again = input[at..at + length].to_vec();
                let to = random.below(input.len() + 1);
                input.splice(to..to, again);
            }
            7 => {
                let other = &target.corpus[random.below(target.corpus.len())];
                let from = random.below(other.len());
                let length = random.below(32).min(other.len() - from);
                input.splice(at..at, other[from..from + length].iter().copied());
            }
            _ if !target.words.is_empty() => {
                input.splice(at..at, target.words[random.below(target.words.len())].bytes());
            }
            _ => {}
        }
    }
    input.truncate(LONGEST);
}

fn from_environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

/// Runs all readers: `inputs` inputs altogether, unless the environment says how many. How many they were.
pub fn fuzz(targets: &[Target], inputs: u64) -> u64 {
    let (inputs, seed) =
        (from_environment("FUZZ_INPUTS").unwrap_or(inputs), from_environment("FUZZ_SEED").unwrap_or(1));
    let threads = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    let mut all = 0;
    for target in targets {
        target.corpus.iter().for_each(|input| (target.run)(input));
        let share = (inputs * target.share / 1_000_000).max(1);
        std::thread::scope(|scope| {
            for thread in 0..threads {
                scope.spawn(move || {
                    let mut input = Vec::new();
                    for number in (thread..share).step_by(threads as usize) {
                        // Each input follows from its number alone.
                        let mut random =
                            Random(SplitMix64(seed.wrapping_mul(0xd129_0c3d_3c4f_2d1b) ^ number.rotate_left(20)));
                        change(target, &mut random, &mut input);
                        if catch_unwind(AssertUnwindSafe(|| (target.run)(&input))).is_err() {
                            panic!(
                                "{}: input {number} of seed {seed} makes it panic: {:?}",
                                target.name,
                                String::from_utf8_lossy(&input)
                            );
                        }
                    }
                });
            }
        });
        println!("{:>12} {share:>12} inputs", target.name);
        all += share;
    }
    println!("{:>12} {all:>12} inputs", "together");
    all
}
