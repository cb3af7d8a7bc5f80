#![deny(unsafe_code)]
//! A simulated CAN bus in virtual time with the modules of a snake robot as its nodes.
//!
//! [`bus`] is the bus, with [`frame_bits`] for the length of frames, [`confinement`] for its error counters and [`faults`] for what goes wrong; [`candump`] writes and
//! reads its logs, [`pcap`] writes them for Wireshark, and [`capture`] beside them what [`replay`] needs to run one module again. [`sil`] puts complete firmware controllers and the ground station ([`station`]) on it and lets them control
//! anything that implements [`Plant`]. A module's controller runs in this process or elsewhere ([`computer`], [`remote`]), above all in an
//! emulated microcontroller ([`qemu`]), and the plant may be in another process too ([`external_plant`]). [`sensor_model`] makes of the true state
//! of a module what its chips read. Nothing of these depends on wall-clock time: the same seed gives the same run, bit for bit. [`live`] is the
//! exception: it lets a run keep pace with the clock on the wall and offers its bus on a pseudo-terminal, in the text protocol [`slcan`], and take [commands](control) that break and mend the robot.
//!
//! A robot on the bench, whose module 3 loses its power while it runs:
//!
//! ```
//! use composer_sim_bridge::computer::InProcess;
//! use composer_sim_bridge::faults::Fault;
//! use composer_sim_bridge::plant::Bench;
//! use composer_sim_bridge::sil::{Change, SilConfig, Simulation};
//! use composer_firmware::controller::BusKind;
//! use composer_shared::{policies, policy::Policy};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let policy = Policy::parse(policies::shipped("goal-reaching").ok_or("no such policy")?)?;
//! let bench = Bench { modules: 8, steps: 1000 };
//! let mut robot = Simulation::new(InProcess::new(policy), bench, policy, SilConfig::new(BusKind::Fd))?;
//! robot.advance_cycles(20)?;
//! robot.change(Change::Begin(Fault::Unplug(3), None))??;
//! robot.advance_cycles(4)?;
//! assert!(robot.look(|seen| seen.modules.iter().all(|module| module.alive >> 3 & 1 == 0))?);
//! robot.change(Change::End(Fault::Unplug(3)))??;
//! robot.advance_cycles(20)?;
//! assert!(robot.look(|seen| seen.modules.iter().all(|module| module.alive == 0xff))?);
//! # Ok(())
//! # }
//! ```

pub mod bus;
pub mod candump;
pub mod capture;
pub mod computer;
pub mod confinement;
pub mod control;
pub mod external_plant;
pub mod faults;
pub mod frame_bits;
#[cfg(unix)]
pub mod live;
pub mod pcap;
pub mod plant;
pub mod policy_flash;
pub mod port;
pub mod qemu;
pub mod remote;
pub mod replay;
pub mod ring;
pub mod sensor_model;
pub mod sil;
pub mod slcan;
pub mod station;

pub use plant::Plant;
