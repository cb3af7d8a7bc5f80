//! SHA-512 (FIPS 180-4), piece by piece, without a panic: the digest of a policy, and the inside of its signature.

const BLOCK: usize = 128;

/// The first 64 bits of the fractional parts of the square roots of the first 8 primes.
const START: [u64; 8] = [
    0x6a09e667f3bcc908,
    0xbb67ae8584caa73b,
    0x3c6ef372fe94f82b,
    0xa54ff53a5f1d36f1,
    0x510e527fade682d1,
    0x9b05688c2b3e6c1f,
    0x1f83d9abfb41bd6b,
    0x5be0cd19137e2179,
];

/// The first 64 bits of the fractional parts of the cube roots of the first 80 primes, 16 a row.
#[rustfmt::skip]
static ROUNDS: [[u64; 16]; 5] = [
    [
        0x428a2f98d728ae22, 0x7137449123ef65cd, 0xb5c0fbcfec4d3b2f, 0xe9b5dba58189dbbc,
        0x3956c25bf348b538, 0x59f111f1b605d019, 0x923f82a4af194f9b, 0xab1c5ed5da6d8118,
        0xd807aa98a3030242, 0x12835b0145706fbe, 0x243185be4ee4b28c, 0x550c7dc3d5ffb4e2,
        0x72be5d74f27b896f, 0x80deb1fe3b1696b1, 0x9bdc06a725c71235, 0xc19bf174cf692694,
    ],
    [
        0xe49b69c19ef14ad2, 0xefbe4786384f25e3, 0x0fc19dc68b8cd5b5, 0x240ca1cc77ac9c65,
        0x2de92c6f592b0275, 0x4a7484aa6ea6e483, 0x5cb0a9dcbd41fbd4, 0x76f988da831153b5,
        0x983e5152ee66dfab, 0xa831c66d2db43210, 0xb00327c898fb213f, 0xbf597fc7beef0ee4,
        0xc6e00bf33da88fc2, 0xd5a79147930aa725, 0x06ca6351e003826f, 0x142929670a0e6e70,
    ],
    [
        0x27b70a8546d22ffc, 0x2e1b21385c26c926, 0x4d2c6dfc5ac42aed, 0x53380d139d95b3df,
        0x650a73548baf63de, 0x766a0abb3c77b2a8, 0x81c2c92e47edaee6, 0x92722c851482353b,
        0xa2bfe8a14cf10364, 0xa81a664bbc423001, 0xc24b8b70d0f89791, 0xc76c51a30654be30,
        0xd192e819d6ef5218, 0xd69906245565a910, 0xf40e35855771202a, 0x106aa07032bbd1b8,
    ],
    [
        0x19a4c116b8d2d0c8, 0x1e376c085141ab53, 0x2748774cdf8eeb99, 0x34b0bcb5e19b48a8,
        0x391c0cb3c5c95a63, 0x4ed8aa4ae3418acb, 0x5b9cca4f7763e373, 0x682e6ff3d6b2b8a3,
        0x748f82ee5defb2fc, 0x78a5636f43172f60, 0x84c87814a1f0ab72, 0x8cc702081a6439ec,
        0x90befffa23631e28, 0xa4506cebde82bde9, 0xbef9a3f7b2c67915, 0xc67178f2e372532b,
    ],
    [
        0xca273eceea26619c, 0xd186b8c721c0c207, 0xeada7dd6cde0eb1e, 0xf57d4f7fee6ed178,
        0x06f067aa72176fba, 0x0a637dc5a2c898a6, 0x113f9804bef90dae, 0x1b710b35131c471b,
        0x28db77f523047d84, 0x32caab7b40c72493, 0x3c9ebe0a15c9bebc, 0x431d67c49c100d4c,
        0x4cc5d4becb3e42b6, 0x597f299cfc657e2a, 0x5fcb6fab3ad6faec, 0x6c44198c4a475817,
    ],
];

/// A digest in the making.
#[derive(Clone, Debug)]
pub struct Sha512 {
    state: [u64; 8],
    /// The beginning of a block.
    block: [u8; BLOCK],
    held: usize,
    /// Bytes so far.
    length: u64,
}

impl Default for Sha512 {
    fn default() -> Self {
        Self::new()
    }
}

impl Sha512 {
    /// Of nothing yet.
    pub const fn new() -> Self {
        Sha512 { state: START, block: [0; BLOCK], held: 0, length: 0 }
    }

    /// Goes on with these bytes.
    pub fn update(&mut self, data: &[u8]) {
        self.length = self.length.wrapping_add(data.len() as u64);
        let mut rest = data;
        if self.held > 0 {
            let room = BLOCK.saturating_sub(self.held);
            let (first, later) = rest.split_at_checked(room).unwrap_or((rest, &[]));
            self.block.iter_mut().skip(self.held).zip(first).for_each(|(to, from)| *to = *from);
            self.held += first.len();
            rest = later;
            if self.held < BLOCK {
                return;
            }
            compress(&mut self.state, &self.block);
        }
        let (blocks, tail) = rest.as_chunks::<BLOCK>();
        blocks.iter().for_each(|block| compress(&mut self.state, block));
        self.block.iter_mut().zip(tail).for_each(|(to, from)| *to = *from);
        self.held = tail.len();
    }

    /// The digest.
    pub fn finalize(mut self) -> [u8; 64] {
        let bits = u128::from(self.length) << 3;
        // A one, zeros up to the last 16 bytes of a block, and the length in them.
        for (at, byte) in self.block.iter_mut().enumerate().skip(self.held) {
            *byte = if at == self.held { 0x80 } else { 0 };
        }
        if self.held >= BLOCK - 16 {
            compress(&mut self.state, &self.block);
            self.block = [0; BLOCK];
        }
        self.block.iter_mut().skip(BLOCK - 16).zip(bits.to_be_bytes()).for_each(|(to, from)| *to = from);
        compress(&mut self.state, &self.block);
        let mut digest = [0; 64];
        let bytes = self.state.iter().flat_map(|word| word.to_be_bytes());
        digest.iter_mut().zip(bytes).for_each(|(to, from)| *to = from);
        digest
    }
}

#[inline(never)]
fn compress(state: &mut [u64; 8], block: &[u8; BLOCK]) {
    let mut w = [0u64; 16];
    for (word, bytes) in w.iter_mut().zip(block.as_chunks::<8>().0) {
        *word = u64::from_be_bytes(*bytes);
    }
    let [mut a, mut b, mut c, mut d, mut e, mut f, mut g, mut h] = *state;
    for (row, constants) in ROUNDS.iter().enumerate() {
        for (j, constant) in constants.iter().enumerate() {
            let j = j & 15;
            if row > 0 {
                let (w1, w14) = (w[(j + 1) & 15], w[(j + 14) & 15]);
                let small0 = w1.rotate_right(1) ^ w1.rotate_right(8) ^ (w1 >> 7);
                let small1 = w14.rotate_right(19) ^ w14.rotate_right(61) ^ (w14 >> 6);
                w[j] = w[j].wrapping_add(w[(j + 9) & 15]).wrapping_add(small0).wrapping_add(small1);
            }
            let large1 = e.rotate_right(14) ^ e.rotate_right(18) ^ e.rotate_right(41);
            let chosen = g ^ (e & (f ^ g));
            let first = h.wrapping_add(large1).wrapping_add(chosen).wrapping_add(*constant).wrapping_add(w[j]);
            let large0 = a.rotate_right(28) ^ a.rotate_right(34) ^ a.rotate_right(39);
            let majority = (a & b) | (c & (a | b));
            (h, g, f) = (g, f, e);
            e = d.wrapping_add(first);
            (d, c, b) = (c, b, a);
            a = first.wrapping_add(large0).wrapping_add(majority);
        }
    }
    for (word, more) in state.iter_mut().zip([a, b, c, d, e, f, g, h]) {
        *word = word.wrapping_add(more);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{format, string::String};

    fn hex(data: &[u8], piece: usize) -> String {
        let mut sha = Sha512::new();
        data.chunks(piece).for_each(|part| sha.update(part));
        sha.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// FIPS 180-4's examples, in pieces of any size.
    #[test]
    fn digests_are_those_of_the_standard() {
        for piece in [1, 3, 64, 127, 128, 129, 1000] {
            assert_eq!(
                hex(b"abc", piece),
                "ddaf35a193617abacc417349ae20413112e6fa4e89a97ea20a9eeee64b55d39a2192992a274fc1a836ba3c23a3feebbd454d4423643ce80e2a9ac94fa54ca49f"
            );
            assert_eq!(
                hex(b"", piece),
                "cf83e1357eefb8bdf1542850d66d8007d620e4050b5715dc83f4a921d36ce9ce47d0d13c5d85f2b0ff8318d2877eec2f63b931bd47417a81a538327af927da3e"
            );
            assert_eq!(
                hex(
                    b"abcdefghbcdefghicdefghijdefghijkefghijklfghijklmghijklmnhijklmnoijklmnopjklmnopqklmnopqrlmnopqrsmnopqrstnopqrstu",
                    piece
                ),
                "8e959b75dae313da8cf4f72814fc143f8f7779c6eb9f7fa17299aeadb6889018501d289e4900f7e4331b99dec4b5433ac7d329eeb6dd26545e96e55b874be909"
            );
        }
    }
}
