//! The imagination policy (paper, section III-B and Algorithm 1): a second policy, in training alone, that says where each module
//! ought to be one control step later. The control policy is rewarded for following it.
//!
//! Like the control policy it is one actor shared by all modules over what each observes (without attention), with a critic of its
//! own, trained by the same PPO from the same rollouts. Its action is a vector u for each module; the module's imagined position is
//!
//! ```text
//! p'_i = p_i + R_i (bound * u_i / max(1, |u_i|))
//! ```
//!
//! with `R_i` the rotation of the module's own frame. Some things are not as the paper prints them, but as they must be meant:
//!
//! - The displacement is bounded. Without a bound "goal minus position" is the best answer everywhere, and no step towards anything. The
//!   bound is a ball: under a box the best answer is nearly always a corner, up to 55 degrees off the way.
//! - Its reward `R^H = d(p', g)` must fall with the distance: [`crate::environment::Environment::imagined_reward`]. The snake earns the
//!   decrease `d(p, g) - d(p', g)` where its task pays for progress and `-0.1 d(p', g)` where it pays the paper's reward.
//! - `r_f`, a sum of errors, is added to the reward in the paper; it must be taken off. Here it is
//!   `r_f = -follow * mean_i |p_{i,t+1} - p'_{i,t}|`, a mean, so that the weight holds for any number of modules.
//! - Where the text and Algorithm 1 give the imagination policy the control policy's parameters theta, its own (psi) are meant.
//!
//! Measured (`snakectl report paper`, README): it learns to point straight at the goal within some 50,000 steps, which a snake cannot
//! follow and which the `progress` reward says too; at `follow` 0.1 it makes no difference, at 1 and above learning is slower.
//!
//! Settings for variants that may do better stand in [`ImaginationConfig`]; [`crate::study`] compares them (`snakectl report imagination`).
//!
//! A dead module neither imagines (it stays where it is) nor is asked to follow.

use anyhow::{Result, bail};
use composer_shared::observation::{BASE, Observation};
use serde::{Deserialize, Serialize};

use super::on_policy::Companion;
use crate::environment::Environment;
use crate::tasks::{Point, distance};

/// Numbers that the imagination policy puts out for a module: a displacement along the three axes of its own frame.
pub const DISPLACEMENT: usize = 3;

/// Settings of the imagination policy; without effect on methods without.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImaginationConfig {
    /// Taken off the control policy's reward for each unit that the modules are away, on average, from where they were imagined.
    pub follow: f64,
    /// Longest imagined displacement, units per control step.
    pub bound: f64,
    /// Standard deviation of each component of u at the start, as a fraction of the bound.
    pub sigma: f64,
    /// Discount of the imagination policy's reward per control step, 0 to 1. What is imagined does not change what happens next in
    /// an episode, so any discount has the same best policy; later rewards only add noise to its gradient.
    pub gamma: f64,
    /// Epochs of its actor (at most, as for the control policy's) and of its critic. Fewer than the control policy's: it has the easier
    /// task, and every epoch costs time.
    pub epochs: usize,
    /// Control steps that a target is held for, at most to the end of the episode. Higher: the way there may lead aside, as a snake's must; give `bound` room
    /// for it.
    pub hold: usize,
    /// The control policy pays for the growth of the distance to the target in a step, not for the distance: over the steps that a target is held it pays for
    /// what is left, and undulation costs nothing.
    pub telescope: bool,
    /// Targets end at the walls that are in their way, and above the ground.
    pub clip: bool,
    /// Every module pays for its own distance alone, at once, instead of all for the mean.
    pub each: bool,
    /// What it earns is measured by where each module itself should be (shapes: its own target, not the nearest assignment; the block: on the line behind the
    /// place to push from, and forward once the head is there).
    pub own_targets: bool,
    /// Taken off its own reward for each unit that the modules are away from a target when it ends. Higher: it imagines what can be followed.
    pub feasible: f64,
    /// Its actor attends to other modules, too.
    pub attention: bool,
    /// The control policy is told what it imagines now: its mean displacement as a share of the bound, three more inputs. No module runs such a policy.
    pub told: bool,
}

impl Default for ImaginationConfig {
    fn default() -> Self {
        Self {
            follow: 0.1,
            bound: 0.5,
            sigma: 0.45,
            gamma: 0.0,
            epochs: 2,
            hold: 1,
            telescope: false,
            clip: false,
            each: false,
            own_targets: false,
            feasible: 0.0,
            attention: false,
            told: false,
        }
    }
}

impl ImaginationConfig {
    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        if !(self.follow.is_finite() && self.follow >= 0.0) {
            bail!("imagination.follow is {}; it must be 0 or more", self.follow);
        }
        for (key, value) in [("bound", self.bound), ("sigma", self.sigma)] {
            if !(value.is_finite() && value > 0.0) {
                bail!("imagination.{key} is {value}; it must be a number above 0");
            }
        }
        if !(self.feasible.is_finite() && self.feasible >= 0.0) {
            bail!("imagination.feasible is {}; it must be 0 or more", self.feasible);
        }
        if !(1..=1000).contains(&self.hold) {
            bail!("imagination.hold is {}; it must be from 1 to 1000", self.hold);
        }
        if !(0.0..=1.0).contains(&self.gamma) {
            bail!("imagination.gamma is {}; it must be from 0 to 1", self.gamma);
        }
        if !(1..=1000).contains(&self.epochs) {
            bail!("imagination.epochs is {}; it must be from 1 to 1000", self.epochs);
        }
        Ok(())
    }
}

/// Rules of the imagination policy.
#[derive(Clone, Debug)]
pub struct Imagination(pub ImaginationConfig);

impl Imagination {
    fn earned(&self, environment: &dyn Environment, plan: &[Point]) -> f32 {
        match self.0.own_targets {
            true => environment.imagined_reward_of_each(plan),
            false => environment.imagined_reward(plan),
        }
    }
}

impl Companion for Imagination {
    fn name(&self) -> &'static str {
        "imagination"
    }

    fn error_name(&self) -> &'static str {
        "follow_error"
    }

    /// Where the modules are imagined to be after the next step, given the actions u; world frame, units.
    fn plan(&self, environment: &dyn Environment, acts: &[bool], actions: &[f32], plan: &mut Vec<Point>) -> f32 {
        let actions = actions.as_chunks::<DISPLACEMENT>().0;
        plan.clear();
        plan.extend(acts.iter().zip(actions).enumerate().map(|(module, (acts, action))| {
            let bound = self.0.bound as f32;
            let target =
                environment.place(module, if *acts { displacement(*action, bound) } else { [0.0; DISPLACEMENT] });
            if self.0.clip { environment.clipped(module, target) } else { target }
        }));
        self.earned(environment, plan)
    }

    fn error(&self, environment: &dyn Environment, acts: &[bool], plan: &[Point]) -> f32 {
        follow_error(environment, acts, plan)
    }

    fn weight(&self) -> f32 {
        self.0.follow as f32
    }

    fn hold(&self) -> usize {
        self.0.hold
    }

    fn telescopes(&self) -> bool {
        self.0.telescope
    }

    fn each(&self) -> bool {
        self.0.each
    }

    fn tells(&self) -> bool {
        self.0.told
    }

    fn tell(&self, means: &[f32], observations: &mut [Observation]) {
        tell(means, observations);
    }

    fn feasible(&self) -> f32 {
        self.0.feasible as f32
    }

    fn keep(&self, environment: &dyn Environment, plan: &[Point]) -> f32 {
        self.earned(environment, plan)
    }

    fn errors(&self, environment: &dyn Environment, acts: &[bool], plan: &[Point]) -> Vec<f32> {
        let of = |(module, (target, acts)): (usize, (&Point, &bool))| {
            if *acts { distance(environment.place(module, [0.0; 3]), *target) } else { 0.0 }
        };
        plan.iter().zip(acts).enumerate().map(of).collect()
    }
}

/// Numbers of an observation that a control policy takes which is told what is imagined.
pub const TOLD_INPUTS: usize = BASE + DISPLACEMENT;

/// Puts the imagination policy's mean actions, `[module][DISPLACEMENT]`, behind the paper's fields of the observations, as displacements with a bound of 1.
pub fn tell(means: &[f32], observations: &mut [Observation]) {
    for (observation, u) in observations.iter_mut().zip(means.as_chunks::<DISPLACEMENT>().0) {
        observation[BASE..TOLD_INPUTS].copy_from_slice(&displacement(*u, 1.0));
    }
}

/// The displacement in the module's own frame that u stands for: `bound` times u, which counts up to a length of 1.
pub fn displacement(u: [f32; DISPLACEMENT], bound: f32) -> [f32; DISPLACEMENT] {
    let scale = bound / libm::sqrtf(u.iter().map(|x| x * x).sum()).max(1.0);
    u.map(|x| scale * x)
}

/// Mean distance, in units, of the modules that act from where they were imagined: `mean_i |p_i - p'_i|`; 0 if none acts.
pub fn follow_error(environment: &dyn Environment, acts: &[bool], imagined: &[Point]) -> f32 {
    let (mut sum, mut count) = (0.0, 0.0f32);
    for (module, imagined) in imagined.iter().enumerate().filter(|(module, _)| acts[*module]) {
        let position = environment.place(module, [0.0; 3]);
        sum += libm::sqrtf((0..3).map(|axis| (position[axis] - imagined[axis]).powi(2)).sum());
        count += 1.0;
    }
    sum / count.max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::{Told, Trivial};

    #[test]
    fn displacements_are_as_long_as_the_bound_at_most_and_keep_their_direction() {
        assert_eq!(displacement([0.5, 0.0, 0.0], 0.4), [0.2, 0.0, 0.0]);
        let long = displacement([3.0, -4.0, 12.0], 0.26);
        for (found, expected) in long.iter().zip([0.06, -0.08, 0.24]) {
            assert!((found - expected).abs() < 1e-6, "{long:?}");
        }
    }

    #[test]
    fn a_dead_module_stays_and_is_left_out_of_the_following_error() {
        let team = Trivial::new(3, Told::All);
        let imagination = Imagination(ImaginationConfig { bound: 1.0, follow: 1.0, ..Default::default() });
        let acts = [true, false, true];
        let mut imagined = Vec::new();
        let actions = [[0.5, 0.0, 0.0], [0.9; 3], [0.0, 0.0, 0.25]];
        imagination.plan(&team, &acts, actions.as_flattened(), &mut imagined);
        assert_eq!(imagined, [[0.5, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 0.25]]);
        imagined[1] = [100.0; 3];
        assert_eq!(follow_error(&team, &acts, &imagined), 0.375);
        assert_eq!(follow_error(&team, &[false; 3], &imagined), 0.0);
    }

    #[test]
    fn settings_are_checked() {
        ImaginationConfig::default().validate().unwrap();
        for (text, complaint) in [
            ("follow = -1.0", "imagination.follow is -1; it must be 0 or more"),
            ("bound = 0.0", "imagination.bound is 0; it must be a number above 0"),
            ("sigma = nan", "imagination.sigma is NaN"),
            ("gamma = 2.0", "imagination.gamma is 2; it must be from 0 to 1"),
            ("epochs = 0", "imagination.epochs is 0; it must be from 1 to 1000"),
        ] {
            let error = toml::from_str::<ImaginationConfig>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(complaint), "{error}");
        }
    }
}
