//! The paper's tasks, one file each: scene, goals, reward, success.

pub mod goal_reaching;
