//! The host of COMPOSER: physics, tasks, training, evaluation, export and the command line.

pub mod env;
pub mod environment;
pub mod eval;
pub mod freeze;
pub mod network;
pub mod robot;
pub mod sil;
pub mod sim;
pub mod tasks;
