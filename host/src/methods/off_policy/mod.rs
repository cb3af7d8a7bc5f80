//! Off-policy learning with deterministic policies (TD3): a replay buffer, twin critics, and targets that follow slowly.

pub mod replay;
pub mod td3;

pub use self::replay::{ReplayBuffer, Transitions};
pub use self::td3::{DeterministicActorCritic, Td3, Td3Settings};
