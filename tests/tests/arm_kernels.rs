//! The kernels of the processor give the host's bits: random inputs with the host's results, compared on the emulated Cortex-M4F.

#[path = "common/arm.rs"]
mod arm;
#[path = "../../firmware/src/bin/qemu_vectors/cases.rs"]
mod cases;

use cases::{ADDRESS, CAPACITY, MAGIC, Side};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Makes up inputs, and writes them down together with the results.
struct Host {
    random: ChaCha8Rng,
    file: Vec<u8>,
    results: usize,
}

impl Side for Host {
    fn input(&mut self, bytes: &mut [u8]) {
        self.random.fill_bytes(bytes);
        // Now and then the ends of the range, in single numbers and everywhere.
        const ENDS: [[u8; 4]; 4] = [[0x80, 0, 0, 0x80], [0x01, 0x80, 0x01, 0x80], [0xff, 0x7f, 0xff, 0x7f], [0; 4]];
        let (end, how) = (ENDS[self.random.random_range(0..ENDS.len())], self.random.random_range(0..32));
        for (i, byte) in bytes.iter_mut().enumerate() {
            // The numbers of a field have 1, 2 or 4 bytes; i16::MIN is no activation, but must not be a special case either.
            if how == 0 || how == 1 && self.random.random_range(0..8) == 0 {
                *byte = end[i % 4];
            }
        }
        self.file.extend_from_slice(bytes);
    }

    fn result(&mut self, _: &'static str, bytes: &[u8]) {
        self.file.extend_from_slice(bytes);
        self.results += 1;
    }
}

/// A file of as many rounds as there is room for.
fn file(seed: u64) -> (Vec<u8>, usize) {
    let mut host = Host { random: ChaCha8Rng::seed_from_u64(seed), file: Vec::new(), results: 0 };
    host.file.extend(MAGIC);
    host.file.extend([0; 4]);
    let (mut rounds, mut longest) = (0u32, 0);
    while host.file.len() + 2 * longest < CAPACITY {
        let before = host.file.len();
        cases::round(&mut host);
        longest = longest.max(host.file.len() - before);
        rounds += 1;
    }
    assert!(host.file.len() <= CAPACITY);
    host.file[MAGIC.len()..MAGIC.len() + 4].copy_from_slice(&rounds.to_le_bytes());
    (host.file, host.results)
}

/// Runs the image on a file.
fn check(file: &[u8]) -> (bool, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("vectors");
    std::fs::write(&path, file).unwrap();
    let image = arm::image("composer-qemu-vectors", "board-qemu");
    let loader = format!("loader,file={},addr={ADDRESS:#x},force-raw=on", path.display());
    arm::emulate(&image, &["-device", &loader])
}

#[test]
fn the_processor_gives_the_hosts_bits() {
    for seed in 1..=6 {
        let (file, results) = file(seed);
        let (good, said) = check(&file);
        assert!(good, "{said}");
        assert!(said.starts_with(&format!("{results} results of ")), "{said}");
        assert!(results > 1_500, "{results}");
        println!("seed {seed}: {said}");
    }
}

#[test]
fn one_wrong_bit_is_noticed() {
    // The last result of the last round, the pitch action.
    let (mut file, _) = file(9);
    *file.last_mut().unwrap() ^= 1;
    let (good, said) = check(&file);
    assert!(!good && said.contains("action: byte 7 of 8 is"), "{said}");
    let (good, said) = check(b"nothing");
    assert!(!good && said.contains("no file of cases"), "{said}");
}
