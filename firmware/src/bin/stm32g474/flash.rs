//! The two regions of the flash that are not code, see [`composer_firmware::memory_map`].

use composer_firmware::memory_map::{NODE_PAGE_ADDRESS, NODE_PAGE_SIZE, POLICY_ADDRESS, POLICY_SIZE};
use composer_firmware::node_page::{NodePage, NodePageError};
use composer_shared::policy::{IMAGE_SIZE, Policy, PolicyError};

const _: () = assert!(IMAGE_SIZE <= POLICY_SIZE as usize);

/// The node page, checked.
pub fn node_page() -> Result<NodePage, NodePageError> {
    // SAFETY: this part of the flash is always readable, the linker places nothing there, and nobody writes it while the program runs.
    NodePage::parse(unsafe { region(NODE_PAGE_ADDRESS, NODE_PAGE_SIZE as usize) })
}

/// The policy, checked; it is read in place.
pub fn policy() -> Result<Policy<'static>, PolicyError> {
    // SAFETY: as above.
    Policy::parse(unsafe { region(POLICY_ADDRESS, IMAGE_SIZE) })
}

/// # Safety
///
/// These bytes must be readable and never change.
unsafe fn region(address: u32, length: usize) -> &'static [u8] {
    // SAFETY: promised by the caller; the address is that of real memory, which no Rust object lies in.
    unsafe { core::slice::from_raw_parts(address as *const u8, length) }
}
