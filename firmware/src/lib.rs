#![no_std]
#![forbid(unsafe_code)]
//! The controller of one snake module, free of I/O.
