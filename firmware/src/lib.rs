#![no_std]
#![forbid(unsafe_code)]
//! The controller of one snake module, free of I/O.
//!
//! [`controller::Controller`] is a state machine: the board (or a simulator) feeds it the time, the sensors and one received CAN frame
//! at a time, applies the torque it answers with, and sends the frames it offers. It allocates nothing, never panics, and does a
//! bounded amount of work per call, whatever the bus delivers.
//!
//! [`attitude`] estimates which way is up; [`drivers`] read the sensors and drive the motors over `embedded-hal`; [`node_page`] is what a board knows of itself.
//!
//! [`neighbours`] keeps what was heard from the other modules and how fresh it is; [`failsafe`] decides when the motors relax
//! and why, by what [`limits`], [`supply`] and [`trips`] say of joints, supply and motors, and within the settings of [`safety`]; [`port`] which
//! frame is sent next. A stop takes a shorter way to the motors, [`torque_off`]. [`link`] is how an emulated module talks to the simulator.

#[cfg(test)]
extern crate std;

pub mod attitude;
pub mod boot;
pub mod budget;
pub mod conflict;
pub mod controller;
pub mod drivers;
pub mod emulated;
pub mod failsafe;
pub mod light;
pub mod limits;
pub mod link;
pub mod memory_map;
pub mod motor_health;
pub mod neighbours;
pub mod node_page;
pub mod port;
pub mod power;
pub mod safety;
pub mod service;
pub mod stop_input;
pub mod storage;
pub mod supply;
pub mod torque_off;
pub mod trips;
pub mod update;
