//! PPO (Schulman et al. 2017), central and zero-padded: one network takes the observations of all modules side by side and puts out all
//! their torques, made for the longest snake; a shorter one fills the rest with zeros (after Chen et al. 2018). The paper's centralised baseline.
//!
//! Networks, losses and settings are those of vwxyzjn/cleanrl's ppo_continuous_action: separate actor and critic of 64-64 tanh, log_std free,
//! from 0, one for each padded action; one ratio over all actions of the robot; the value's squared error counts 0.25, clipped like the ratio;
//! one Adam and one limit of the gradient for both; advantages standardised in each minibatch; rewards divided by the standard deviation of
//! their running discounted sum.
//!
//! Padding: modules head first, zeros at the tail, so that a longer snake keeps the places of the modules it shares. **The statistics of the
//! observations are pooled over the modules that are there**, as for every method here. With statistics of its own for every input, a padded
//! one would have a standard deviation of nearly 0 and the first real number there would be cut off at the limit: that decides what a ninth module
//! does. Actions of padding count neither in the ratio nor in the entropy (naively they do; the authors' numbers are of that, and are met
//! by a team of that length which sees zeros). Trained on eight modules alone, the places from the ninth on never learn.
//!
//! Mended here as in all baselines: an episode cut off by the time limit is worth what the critic says of its last view, which is that before
//! the reset; statistics are one set for all environments, still during an iteration, and frozen for evaluation. The running
//! discounted sum of rewards starts anew with every episode.

use composer_shared::observation::BASE;

use super::layers::{Matrix, Network, Tape};
use super::layout::{Activation, Layout, Scheme};
use super::on_policy::collect::ACTIONS;
use super::on_policy::losses::ValueLoss;
use super::on_policy::taped::{Deviation, Seen, TapedNetworks};
use super::on_policy::{Ratio, Valued};
use super::{Method, SavedWeights, TrainedPolicy};

/// Modules of the longest snake of the paper's tables.
pub const MOST_MODULES: usize = 11;
/// Width of the hidden layers.
const WIDTH: usize = 64;

/// Actor and critic for snakes of at most so many modules.
#[derive(Clone, Copy, Debug)]
pub struct Ppo {
    /// The most modules.
    pub modules: usize,
}

impl Ppo {
    /// The output of a network of three layers that sees all observations of each team side by side, padded with zeros.
    fn through(self, t: &mut Tape, w: Network, of: &str, seen: &Seen) -> Matrix {
        let mut joint = Vec::with_capacity(seen.modules.len() * self.modules * BASE);
        for (team, (heard, observations)) in seen.teams().enumerate() {
            for (module, observation) in observations.as_chunks::<BASE>().0.iter().enumerate() {
                // A module that the head does not hear is as absent as padding.
                let present = heard >> module & 1 == 1;
                joint.extend(if present { *observation } else { [0.0; BASE] });
            }
            joint.resize((team + 1) * self.modules * BASE, 0.0);
        }
        let x = t.input(&joint, self.modules * BASE);
        let x = t.activated(w, &format!("{of}.0"), Activation::Tanh, x);
        let x = t.activated(w, &format!("{of}.2"), Activation::Tanh, x);
        t.linear(w, &format!("{of}.4"), x)
    }
}

impl TapedNetworks for Ppo {
    fn layouts(&self) -> [Layout; 2] {
        let mut layout = Layout::default();
        let gain = Scheme::Orthogonal(std::f32::consts::SQRT_2);
        for (of, outputs, last) in [("actor_mean", self.modules * ACTIONS, 0.01), ("critic", 1, 1.0)] {
            layout.linear(&format!("{of}.0"), self.modules * BASE, WIDTH, gain);
            layout.linear(&format!("{of}.2"), WIDTH, WIDTH, gain);
            layout.linear(&format!("{of}.4"), WIDTH, outputs, Scheme::Orthogonal(last));
        }
        layout.vector("actor_logstd", self.modules * ACTIONS, 0.0);
        [layout, Layout::default()]
    }

    fn log_std(&self) -> (&'static str, Deviation) {
        ("actor_logstd", Deviation::Exponential)
    }

    fn most_modules(&self) -> Option<usize> {
        Some(self.modules)
    }

    fn ratio(&self) -> Ratio {
        Ratio::Team
    }

    fn valued(&self) -> Valued {
        Valued::Team
    }

    fn value_loss(&self) -> ValueLoss {
        ValueLoss { coefficient: 0.5, huber: None }
    }

    fn entropy_sums(&self) -> [bool; 2] {
        [true, true]
    }

    fn means(&self, t: &mut Tape, w: Network, seen: &Seen, _actions: &[f32]) -> Matrix {
        let all = self.through(t, w, "actor_mean", seen);
        t.rows(all, ACTIONS, &seen.heard)
    }

    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix {
        self.through(t, w, "critic", seen)
    }

    fn policy(&self, parameters: &[f32], mean: &[f32], std: &[f32]) -> TrainedPolicy {
        let saved = SavedWeights::raw(Method::Ppo, parameters);
        TrainedPolicy::Weights(SavedWeights {
            modules: self.modules,
            mean: mean.to_vec(),
            std: std.to_vec(),
            clip: OBSERVATION_CLIP,
            ..saved
        })
    }
}

/// Normalised observations are cut off here.
pub const OBSERVATION_CLIP: f32 = 10.0;
