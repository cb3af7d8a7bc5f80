//! stub
#[path = "common/arm.rs"]
mod arm;
#[path = "common/elf.rs"]
mod elf;
#[path = "common/thumb.rs"]
mod thumb;
