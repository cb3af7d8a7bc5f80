//! Flash as the STM32G4 has it, for tests: words of 8 bytes that are written once, and what a loss of power makes of them.

use std::vec::Vec;

use composer_shared::random::SplitMix64;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};

use crate::update::{PolicyFlash, SECTION, SIZE};

const WORD: usize = 8;
const WORDS: usize = SIZE as usize / WORD;
const SECTION_WORDS: usize = SECTION as usize / WORD;

/// What a word is like that lost its power while it was written or erased.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Torn {
    /// Its checksum is wrong: reading fails.
    Faulty,
    /// It reads as erased, and cannot be written.
    Blank,
    /// It reads as what was to be written.
    Whole,
    /// Some of its bits are written.
    Partly,
    /// It reads as what was to be written, and fails to, in turn.
    Wavering,
}

impl Torn {
    pub const ALL: [Torn; 5] = [Torn::Faulty, Torn::Blank, Torn::Whole, Torn::Partly, Torn::Wavering];
}

/// One operation: what a loss of power can cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Op {
    Write { word: usize, value: [u8; WORD] },
    Erase { section: usize },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Word {
    Erased,
    Written,
    Torn(Torn),
}

/// The flash.
#[derive(Clone)]
pub struct G4 {
    bytes: Vec<u8>,
    words: Vec<Word>,
    /// What was done since the log was taken last.
    log: Vec<Op>,
    looks: u32,
    noise: u32,
    /// Of what all words hold and how they are.
    digest: u64,
    /// Words that read now like this and now like that.
    wavering: usize,
}

/// A word as it is, to be put back.
#[derive(Clone, Copy)]
pub struct Saved {
    word: usize,
    value: [u8; WORD],
    is: Word,
}

/// The share that a word has in the digest.
fn mark(Saved { word, value, is }: Saved) -> u64 {
    let is = match is {
        Word::Erased => 0,
        Word::Written => 1,
        Word::Torn(torn) => 2 + torn as u64,
    };
    let place = SplitMix64((word as u64) << 4 | is).next_u64();
    SplitMix64(place ^ u64::from_le_bytes(value)).next_u64()
}

impl G4 {
    pub fn new() -> Self {
        G4 {
            bytes: std::vec![0xff; SIZE as usize],
            words: std::vec![Word::Erased; WORDS],
            log: Vec::new(),
            looks: 0,
            noise: 1,
            digest: 0,
            wavering: 0,
        }
    }

    /// Two of the same digest hold the same, as far as 64 bits can tell.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Whether a word reads now like this and now like that.
    pub fn wavers(&self) -> bool {
        self.wavering > 0
    }

    /// Words that waver begin with the one reading or with the other.
    pub fn waver(&mut self, phase: u32) {
        self.looks = phase;
    }

    /// A word as it is now.
    pub fn save(&self, word: usize) -> Saved {
        Saved { word, value: self.bytes[word * WORD..][..WORD].try_into().unwrap(), is: self.words[word] }
    }

    /// Makes a word as it was, or as it is to be.
    pub fn put(&mut self, new: Saved) {
        let wavers = |is| usize::from(is == Word::Torn(Torn::Wavering));
        self.wavering = self.wavering + wavers(new.is) - wavers(self.words[new.word]);
        self.digest ^= mark(self.save(new.word)) ^ mark(new);
        self.bytes[new.word * WORD..][..WORD].copy_from_slice(&new.value);
        self.words[new.word] = new.is;
    }

    /// What was done since the last call.
    pub fn take_log(&mut self) -> Vec<Op> {
        std::mem::take(&mut self.log)
    }

    fn random(&mut self) -> u32 {
        self.noise = self.noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.noise >> 8
    }

    /// Does one operation, as it was done before.
    pub fn apply(&mut self, op: &Op) {
        match *op {
            Op::Write { word, value } => self.put(Saved { word, value, is: Word::Written }),
            Op::Erase { section } => {
                for word in section * SECTION_WORDS..(section + 1) * SECTION_WORDS {
                    self.put(Saved { word, value: [0xff; WORD], is: Word::Erased });
                }
            }
        }
    }

    /// The power goes while this is done. An erasure leaves some words as they were, some erased, and some torn.
    pub fn tear(&mut self, op: &Op, torn: Torn, seed: u32) {
        self.noise = seed.wrapping_mul(0x9e37_79b9) | 1;
        match *op {
            Op::Write { word, value } => self.tear_word(word, value, torn),
            Op::Erase { section } => {
                for word in section * SECTION_WORDS..(section + 1) * SECTION_WORDS {
                    match self.random() % 4 {
                        0 => {}
                        1 => self.put(Saved { word, value: [0xff; WORD], is: Word::Erased }),
                        _ => self.tear_word(word, self.save(word).value, torn),
                    }
                }
            }
        }
    }

    fn tear_word(&mut self, word: usize, value: [u8; WORD], torn: Torn) {
        let written = match torn {
            Torn::Whole | Torn::Wavering | Torn::Faulty => value,
            Torn::Blank => [0xff; WORD],
            Torn::Partly => value.map(|byte| byte | self.random() as u8),
        };
        self.put(Saved { word, value: written, is: Word::Torn(torn) });
    }
}

impl ErrorType for G4 {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for G4 {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let from = offset as usize;
        self.looks = self.looks.wrapping_add(1);
        for word in &self.words[from / WORD..(from + bytes.len()).div_ceil(WORD)] {
            let fails = match word {
                Word::Torn(Torn::Faulty) => true,
                Word::Torn(Torn::Wavering) => self.looks.is_multiple_of(2),
                _ => false,
            };
            if fails {
                return Err(NorFlashErrorKind::Other);
            }
        }
        bytes.copy_from_slice(&self.bytes[from..from + bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SIZE as usize
    }
}

impl NorFlash for G4 {
    const WRITE_SIZE: usize = WORD;
    const ERASE_SIZE: usize = SECTION as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        assert!(from.is_multiple_of(SECTION) && to == from + SECTION && to <= SIZE, "one section at a time");
        let op = Op::Erase { section: (from / SECTION) as usize };
        self.apply(&op);
        self.log.push(op);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        assert!(offset.is_multiple_of(8) && bytes.len().is_multiple_of(8));
        for (i, value) in bytes.as_chunks::<WORD>().0.iter().enumerate() {
            let word = offset as usize / WORD + i;
            if self.words[word] != Word::Erased {
                return Err(NorFlashErrorKind::Other);
            }
            let op = Op::Write { word, value: *value };
            self.apply(&op);
            self.log.push(op);
        }
        Ok(())
    }
}

impl PolicyFlash for G4 {
    fn bytes(&self, from: u32, length: usize) -> Option<&[u8]> {
        self.bytes.get(from as usize..)?.get(..length)
    }
}
