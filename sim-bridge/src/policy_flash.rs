//! The flash of a simulated module's policies.

use std::sync::Mutex;

use composer_firmware::emulated::Lasting;
use composer_firmware::update::{PolicyFlash, SECTION, SIZE, image_of};
use composer_shared::update::Slot;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_read, check_write,
};

static ERASED: [u8; SIZE as usize] = [0xff; SIZE as usize];

/// Memory that behaves like flash: words are written where it is erased, once. It takes none before it is written for the first time.
#[derive(Clone, Debug, Default)]
pub struct Policies {
    bytes: Option<Box<[u8]>>,
}

impl Policies {
    fn all(&self) -> &[u8] {
        self.bytes.as_deref().unwrap_or(&ERASED)
    }
}

/// Images that modules were given, each once. They stay for as long as the process, because controllers borrow them.
static IMAGES: Mutex<Vec<&'static [u8]>> = Mutex::new(Vec::new());

impl<'a> Lasting<'a> for Policies {
    fn lasting(&mut self, slot: Slot) -> Option<&'a [u8]> {
        let image = image_of(self, slot)?;
        let mut images = IMAGES.lock().ok()?;
        if let Some(known) = images.iter().find(|known| **known == image) {
            return Some(known);
        }
        let image: &'static [u8] = Box::leak(image.into());
        images.push(image);
        Some(image)
    }
}

impl ErrorType for Policies {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Policies {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        check_read(self, offset, bytes.len())?;
        bytes.copy_from_slice(&self.all()[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        SIZE as usize
    }
}

impl NorFlash for Policies {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = SECTION as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        if let Some(bytes) = &mut self.bytes {
            bytes[from as usize..to as usize].fill(0xff);
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let all = self.bytes.get_or_insert_with(|| ERASED[..].into());
        let target = &mut all[offset as usize..][..bytes.len()];
        if target.iter().any(|byte| *byte != 0xff) {
            return Err(NorFlashErrorKind::Other);
        }
        target.copy_from_slice(bytes);
        Ok(())
    }
}

impl PolicyFlash for Policies {
    fn bytes(&self, from: u32, length: usize) -> Option<&[u8]> {
        self.all().get(from as usize..)?.get(..length)
    }
}
