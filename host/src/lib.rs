//! The host of COMPOSER: physics, tasks, training, evaluation, export and the command line.

pub mod env;
pub mod environment;
pub mod robot;
pub mod sim;
pub mod tasks;
