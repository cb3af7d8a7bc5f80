//! Where things lie in the flash of the board `stm32g474`: the one definition, for the board that reads, for the host that
//! writes, and for the linker script `boards/stm32g474.x`, which the linker holds against these numbers.
//!
//! | region | from | bytes | content |
//! |---|---|---|---|
//! | code | 0x0800_0000 | 432 K | the image |
//! | policy | 0x0806_c000 | 64 K | the policies (`update`): slots A and B of 28 K, and 8 K of records that say which counts |
//! | storage | 0x0807_c000 | 16 K | what the module writes itself (`storage`): 8 K fault log, 4 K copy of the node page, and last: |
//! | node page | 0x0807_f000 | 4 K | what makes this module this module (`node_page`) |
//!
//! Every region begins at a multiple of 4 KB, the largest page that this chip has (2 KB with two banks, 4 KB with one), so that each can be
//! erased without its neighbours.

/// First byte of the flash.
pub const FLASH_ADDRESS: u32 = 0x0800_0000;
/// Bytes of flash for code and constants.
pub const FLASH_SIZE: u32 = 432 * 1024;
/// Where the policies lie: slot A, slot B, their records.
pub const POLICY_ADDRESS: u32 = FLASH_ADDRESS + FLASH_SIZE;
/// Bytes of all of it.
pub const POLICY_SIZE: u32 = 64 * 1024;
/// Where the records lie.
pub const RECORDS_ADDRESS: u32 = POLICY_ADDRESS + 56 * 1024;
/// Where the module keeps what it writes itself: four sections, the last of which is the node page.
pub const STORAGE_ADDRESS: u32 = POLICY_ADDRESS + POLICY_SIZE;
/// From one section of the storage to the next: what the chip may erase at once.
pub const SECTION_SIZE: u32 = 4 * 1024;
/// Bytes of the storage.
pub const STORAGE_SIZE: u32 = 4 * SECTION_SIZE;
/// Where the node page lies, the last section of the storage.
pub const NODE_PAGE_ADDRESS: u32 = STORAGE_ADDRESS + 3 * SECTION_SIZE;

// All 512 KB are given away, and nothing twice.
const _: () = assert!(STORAGE_ADDRESS + STORAGE_SIZE == FLASH_ADDRESS + 512 * 1024);
