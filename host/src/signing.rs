//! Keys, and policies that are signed with them: Ed25519, as `shared/update-format.md` has it.
//!
//! A key file is text: a line that says what it is, and a line with 64 hexadecimal digits, the seed of a secret key or a public key.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use composer_shared::policy::{IMAGE_SIZE, Policy};
use composer_shared::sha512::Sha512;
use composer_shared::update::{
    self, COUNTER_MAX, HEADER_SIZE, Header, HeaderError, HeaderRepr, KEY_ID_SIZE, Key, SIGNED,
};
use ed25519_dalek::{Signature, Signer, SigningKey, Verifier, VerifyingKey};

const SECRET: &str = "composer secret key, Ed25519";
const PUBLIC: &str = "composer public key, Ed25519";

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Option<[u8; 32]> {
    let mut bytes = [0; 32];
    if text.len() != 64 || !text.is_ascii() {
        return None;
    }
    for (at, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(text.get(2 * at..2 * at + 2)?, 16).ok()?;
    }
    Some(bytes)
}

/// The name of a key for people: its first bytes, as a signed policy names it.
pub fn name(key: &Key) -> String {
    hex(&key[..KEY_ID_SIZE])
}

/// Where the public key of a secret key lies.
pub fn public_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".pub");
    name.into()
}

/// Makes a secret key from the system's randomness, and its public key beside it. Neither file may be there already. Gives the public key.
pub fn make_key(path: &Path) -> Result<Key> {
    let mut seed = [0; 32];
    getrandom::fill(&mut seed).map_err(|error| anyhow::anyhow!("the system gives no random numbers: {error}"))?;
    let key = SigningKey::from_bytes(&seed);
    let public = key.verifying_key().to_bytes();
    // The public one first: alone it does no harm.
    write_new(&public_path(path), &format!("{PUBLIC}\n{}\n", hex(&public)), false)?;
    let written = write_new(path, &format!("{SECRET}\n{}\n", hex(&seed)), true);
    if written.is_err() {
        let _ = std::fs::remove_file(public_path(path));
    }
    written.map(|()| public)
}

fn write_new(path: &Path, text: &str, secret: bool) -> Result<()> {
    let mut options = std::fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, if secret { 0o600 } else { 0o644 });
    #[cfg(not(unix))]
    let _ = secret;
    let mut file = match options.open(path) {
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
            bail!("{} exists already: a key is never overwritten, name another file", path.display())
        }
        file => file.with_context(|| format!("cannot write {}; is the folder there and writable?", path.display()))?,
    };
    let written = file.write_all(text.as_bytes()).and_then(|()| file.sync_all());
    if written.is_err() {
        let _ = std::fs::remove_file(path);
    }
    written.with_context(|| format!("cannot write {}", path.display()))
}

/// What a key file holds.
fn read(path: &Path) -> Result<(bool, [u8; 32])> {
    let shown = path.display();
    let text = std::fs::read(path).with_context(|| format!("cannot read the key {shown}"))?;
    let text = String::from_utf8(text).unwrap_or_default();
    let mut lines = text.lines();
    let (kind, bytes) = (lines.next().unwrap_or_default(), lines.next().and_then(unhex));
    let secret = match kind {
        SECRET => true,
        PUBLIC => false,
        _ => bail!("{shown} is no key of this program: `snakectl key new FILE` makes one"),
    };
    let bytes = bytes.filter(|_| lines.next().is_none());
    let bytes =
        bytes.with_context(|| format!("{shown} is damaged: its second line should be 64 hexadecimal digits"))?;
    Ok((secret, bytes))
}

/// A secret key. Refused if others may read the file.
fn secret_key(path: &Path) -> Result<SigningKey> {
    let (secret, bytes) = read(path)?;
    let shown = path.display();
    ensure!(secret, "{shown} is a public key, and signing needs the secret one, the file beside it without .pub");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode =
            std::fs::metadata(path).with_context(|| format!("cannot read the key {shown}"))?.permissions().mode();
        ensure!(mode & 0o077 == 0, "others may read the secret key {shown}: `chmod 600 {shown}`, or make a new one");
    }
    Ok(SigningKey::from_bytes(&bytes))
}

/// A public key. Refused if it is a secret one: that belongs onto no module.
pub fn public_key(path: &Path) -> Result<Key> {
    let (secret, bytes) = read(path)?;
    let shown = path.display();
    ensure!(
        !secret,
        "{shown} is a secret key, and what a module gets is the public one, {}",
        public_path(path).display()
    );
    let key = VerifyingKey::from_bytes(&bytes).ok().filter(|key| !key.is_weak());
    ensure!(key.is_some(), "{shown} is damaged: it is no public key of Ed25519");
    Ok(bytes)
}

/// What a key file is, and its public key.
pub fn show_key(path: &Path) -> Result<(&'static str, Key)> {
    let (secret, _) = read(path)?;
    match secret {
        true => Ok(("secret", secret_key(path)?.verifying_key().to_bytes())),
        false => Ok(("public", public_key(path)?)),
    }
}

/// A policy with its header, as a module's slot holds it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Package {
    bytes: Vec<u8>,
    header: HeaderRepr,
}

impl Package {
    /// An image that nobody signed.
    pub fn unsigned(image: &[u8]) -> Result<Self> {
        let header = header(image, 0, 0)?;
        Ok(Package { bytes: [&header.emit(None)[..], image].concat(), header })
    }

    /// An image, signed with the secret key in a file.
    pub fn sign(image: &[u8], key: &Path, counter: u32, edition: u32) -> Result<Self> {
        let key = secret_key(key)?;
        ensure!(counter <= COUNTER_MAX, "--counter is at most {COUNTER_MAX}");
        let mut header = header(image, counter, edition)?;
        header.key_id.copy_from_slice(&key.verifying_key().as_bytes()[..KEY_ID_SIZE]);
        let unsigned = header.emit(Some(&[0; 64]));
        let signature = key.sign(&unsigned[..SIGNED]).to_bytes();
        Ok(Package { bytes: [&header.emit(Some(&signature))[..], image].concat(), header })
    }

    /// Header and image, or an image alone, as it was read. What a module would refuse whatever its keys are is refused here.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let header = match Header::new_checked(bytes) {
            Err(HeaderError::Magic) => return Self::unsigned(bytes),
            header => *header?.repr(),
        };
        let image = bytes.get(HEADER_SIZE..).unwrap_or_default();
        ensure!(
            image.len() == header.length as usize,
            "the signed policy has an image of {} bytes where its header states {}: it is cut short, or has grown",
            image.len(),
            header.length
        );
        ensure!(
            digest(image) == header.digest,
            "the signed policy is damaged: its image is not the one that was signed"
        );
        let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
        ensure!(
            (policy.crc(), policy.task()) == (header.crc, header.task),
            "the signed policy is damaged: its header says something else than its image"
        );
        Ok(Package { bytes: bytes.to_vec(), header })
    }

    /// All of it.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The image.
    pub fn image(&self) -> &[u8] {
        self.bytes.get(HEADER_SIZE..).unwrap_or_default()
    }

    /// What the header says.
    pub fn header(&self) -> &HeaderRepr {
        &self.header
    }

    /// Whether somebody signed it.
    pub fn signed(&self) -> bool {
        self.header.key_id != [0; KEY_ID_SIZE]
    }

    /// Whether this key did.
    pub fn is_signed_with(&self, key: &Key) -> bool {
        let Ok(header) = Header::new_checked(&self.bytes) else { return false };
        let (Some(signature), Ok(key)) = (header.signature(), VerifyingKey::from_bytes(key)) else { return false };
        key.verify(header.signed_part(), &Signature::from_bytes(signature)).is_ok()
    }

    /// The number by which its chunks are told from others'.
    pub fn session(&self) -> u16 {
        update::session(&self.bytes)
    }
}

fn digest(image: &[u8]) -> [u8; 64] {
    let mut sha = Sha512::new();
    sha.update(image);
    sha.finalize()
}

fn header(image: &[u8], counter: u32, edition: u32) -> Result<HeaderRepr> {
    const { assert!(IMAGE_SIZE <= update::IMAGE_MAX) };
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    Ok(HeaderRepr {
        length: image.len() as u32,
        counter,
        edition,
        task: policy.task(),
        crc: policy.crc(),
        digest: digest(image),
        key_id: [0; KEY_ID_SIZE],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::policies;

    fn image() -> &'static [u8] {
        policies::shipped("goal-reaching").unwrap()
    }

    #[test]
    fn what_was_signed_is_read_and_verified_by_a_module() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lab");
        let public = make_key(&path).unwrap();
        assert_eq!(public_key(&public_path(&path)).unwrap(), public);
        assert_eq!(show_key(&path).unwrap(), ("secret", public));
        let package = Package::sign(image(), &path, 7, 3).unwrap();
        assert_eq!(Package::parse(package.bytes()).unwrap(), package);
        assert_eq!((package.header().counter, package.header().edition, package.image()), (7, 3, image()));
        let header = Header::new_checked(package.bytes()).unwrap();
        let signature = header.signature().unwrap();
        assert!(composer_firmware::update::verify(&public, header.signed_part(), signature));
        assert!(package.is_signed_with(&public) && !package.is_signed_with(&[1; 32]));
        let unsigned = Package::parse(image()).unwrap();
        assert!(!unsigned.signed() && unsigned.image() == image());
    }

    #[test]
    fn files_that_are_no_keys_or_are_open_to_others_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lab");
        make_key(&path).unwrap();
        let public = public_path(&path);
        let refuse = |result: Result<()>, word: &str| {
            let error = format!("{:#}", result.unwrap_err());
            assert!(error.contains(word) && !error.contains('\n'), "{error}");
        };
        let sign = |key: &Path| Package::sign(image(), key, 0, 0).map(drop);
        refuse(make_key(&path).map(drop), "exists already");
        refuse(sign(&public), "is a public key");
        refuse(public_key(&path).map(drop), "is a secret key");
        let other = folder.path().join("other");
        std::fs::write(&other, "ssh-ed25519 AAAA").unwrap();
        refuse(sign(&other), "no key of this program");
        std::fs::write(&other, format!("{PUBLIC}\nabcd\n")).unwrap();
        refuse(public_key(&other).map(drop), "64 hexadecimal digits");
        std::fs::write(&other, format!("{PUBLIC}\n{}\n", "00".repeat(32))).unwrap();
        refuse(public_key(&other).map(drop), "no public key");
        refuse(sign(&folder.path().join("none")), "cannot read the key");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
            refuse(sign(&path), "others may read the secret key");
        }
    }

    #[test]
    fn what_no_module_would_take_is_refused_before() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lab");
        make_key(&path).unwrap();
        let good = Package::sign(image(), &path, 0, 0).unwrap();
        let mut flipped = good.bytes().to_vec();
        flipped[5000] ^= 1;
        for (bytes, word) in [
            (good.bytes()[..9000].to_vec(), "cut short"),
            (flipped, "is not the one that was signed"),
            (good.bytes()[..100].to_vec(), "cut short"),
            (b"anything".to_vec(), ""),
        ] {
            let error = Package::parse(&bytes).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }
}
