//! The host of COMPOSER: physics, tasks, training, evaluation, export and the command line.

pub mod bus;
pub mod bus_trial;
pub mod campaign;
pub mod classic;
pub mod cli;
pub mod distil;
pub mod env;
pub mod environment;
pub mod eval;
pub mod external;
pub mod fault_map;
pub mod files;
pub mod flash;
pub mod freeze;
pub mod mcap;
pub mod methods;
pub mod mjcf;
pub mod network;
pub mod outcome;
pub mod paper;
pub mod plot;
pub mod policy;
pub mod policy_source;
pub mod recorder;
pub mod release;
pub mod replay;
pub mod robot;
pub mod rows;
pub mod run;
pub mod run_folder;
pub mod scenario;
pub mod shard;
pub mod side_by_side;
pub mod signing;
pub mod sil;
pub mod sim;
pub mod stats;
pub mod study;
pub mod tasks;
pub mod train;
pub mod vary;

/// The page about new methods, whose code is compiled and run.
#[cfg(doctest)]
#[doc = include_str!("../new-method.md")]
pub struct NewMethod;
