//! The environment as the learner sees it.

use composer_shared::observation::Observation;

/// Numbers a module that only the critic sees, in training.
pub const PRIVILEGED: usize = 12;

/// One step of a multi-module environment; every list has one entry a module.
#[derive(Clone, Debug, Default)]
pub struct View {
    /// What each module observes.
    pub observations: Vec<Observation>,
    /// What the critic sees besides.
    pub privileged: Vec<[f32; PRIVILEGED]>,
    /// `heard[i]` bit `j`: module `i` hears module `j`'s latent. The own bit is implied.
    pub heard: Vec<u64>,
    /// False: the module is dead, its action has no effect and is left out of the loss.
    pub acts: Vec<bool>,
}

/// What one step led to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Reward of the step, shared by all modules.
    pub reward: f32,
    /// The episode ended by itself (success).
    pub terminated: bool,
    /// The episode was cut at the cap.
    pub truncated: bool,
    /// The task is done.
    pub success: bool,
    /// The task's distance, robot units.
    pub distance: f32,
    /// Control steps since the reset.
    pub steps: u32,
    /// Sum of rewards since the reset.
    pub episode_return: f32,
}

/// A deterministic multi-module environment.
pub trait Environment: Send {
    /// Modules in this environment.
    fn modules(&self) -> usize;
    /// Starts an episode; everything random in it comes from the seed.
    fn reset(&mut self, seed: u64);
    /// Fills `view` with the current step.
    fn view(&self, view: &mut View);
    /// Advances by one control step. Actions are normalised torques, clipped here.
    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome;
}
