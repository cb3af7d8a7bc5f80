//! Ed25519 (RFC 8032), as `ed25519-dalek` has it: the curve is salty's, the digest our own, which cannot panic.

use composer_shared::sha512::Sha512;
use composer_shared::update::{Key, SIGNATURE_SIZE};
use salty::{CompressedY, EdwardsPoint, Scalar};

/// The order of the group, little-endian (RFC 8032, 5.1).
const ORDER: [u8; 32] = [
    0xed, 0xd3, 0xf5, 0x5c, 0x1a, 0x63, 0x12, 0x58, 0xd6, 0x9c, 0xf7, 0xa2, 0xde, 0xf9, 0xde, 0x14, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0x10,
];

/// Whether the second half of a signature is less than the order of the group. Without that anybody could make another good signature of a good one, which
/// salty by itself would take.
fn is_reduced(signature: &[u8; SIGNATURE_SIZE]) -> bool {
    let digits = signature.iter().skip(32).zip(&ORDER).rev();
    digits.into_iter().find(|(digit, limit)| digit != limit).is_some_and(|(digit, limit)| digit < limit)
}

/// Whether this key signed this message: whether R = s B - k A, where R and s are the signature, A is the key, and k the digest of R, A and the message.
#[inline(never)] // The linked image is looked at from here on: its stack, its instructions.
pub fn verify(key: &Key, message: &[u8], signature: &[u8; SIGNATURE_SIZE]) -> bool {
    let Ok(point) = CompressedY(*key).decompressed() else { return false };
    let ([r, s], []) = signature.as_chunks::<32>() else { return false };
    if !is_reduced(signature) {
        return false;
    }
    let mut sha = Sha512::new();
    [r, &key[..], message].into_iter().for_each(|part| sha.update(part));
    let k = Scalar::from_u512_le(&sha.finalize());
    sum(s, &EdwardsPoint::basepoint(), &k.0, &-&point).compressed().0 == *r
}

/// `m` times P and `n` times Q, together, bit by bit: half as much work as one after the other. Nothing of it is secret, so its time may depend on the numbers.
fn sum(m: &[u8; 32], p: &EdwardsPoint, n: &[u8; 32], q: &EdwardsPoint) -> EdwardsPoint {
    let both = p + q;
    let mut sum = EdwardsPoint::neutral_element();
    for (m, n) in m.iter().zip(n).rev() {
        for bit in (0..8).rev() {
            sum = &sum + &sum;
            match (m >> bit & 1, n >> bit & 1) {
                (0, 0) => {}
                (_, 0) => sum = &sum + p,
                (0, _) => sum = &sum + q,
                _ => sum = &sum + &both,
            }
        }
    }
    sum
}
