//! The policies that ship.

/// Names of the policies that ship, those of their tasks.
pub const NAMES: [&str; 5] = ["goal-reaching", "block-pushing", "shape-formation", "tube-crossing", "wall-climbing"];

/// The image of a policy that ships.
pub fn shipped(name: &str) -> Option<&'static [u8]> {
    match name {
        "goal-reaching" => Some(include_bytes!("../policies/goal-reaching.policy")),
        "block-pushing" => Some(include_bytes!("../policies/block-pushing.policy")),
        "shape-formation" => Some(include_bytes!("../policies/shape-formation.policy")),
        "tube-crossing" => Some(include_bytes!("../policies/tube-crossing.policy")),
        "wall-climbing" => Some(include_bytes!("../policies/wall-climbing.policy")),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::{Policy, Task};

    #[test]
    fn every_policy_that_ships_is_valid_and_of_its_task() {
        for name in NAMES {
            let image = shipped(name).unwrap();
            let policy = Policy::parse(image).unwrap();
            assert_eq!(Some(policy.task()), Task::from_name(name));
            assert!(policy.trained_with_faults());
        }
        assert_eq!(shipped("dancing"), None);
    }
}
