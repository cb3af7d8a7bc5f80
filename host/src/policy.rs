//! Whoever decides the torques of all modules of a robot: what evaluation, replay and benchmark run, whatever method made it.

use composer_shared::policy::{Encoded, Latent, MEMORY, Memory, Policy as Image};
use composer_shared::robot::MAX_MODULES;

use crate::environment::View;
use crate::methods::mix;

/// What the modules remember of an episode, each for itself: nothing at its start. A policy uses what it knows of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Memories {
    /// Of an integer policy, one a module.
    pub integer: Vec<Memory>,
    /// Of a float policy, one a module.
    pub float: Vec<[f32; MEMORY]>,
}

impl Memories {
    /// Room for all modules of a view; a module that is not there, because it has no power, remembers nothing.
    pub fn follow(&mut self, view: &View) {
        let modules = view.observations.len();
        self.integer.resize(modules, Memory::EMPTY);
        self.float.resize(modules, [0.0; MEMORY]);
        for (module, _) in view.acts.iter().enumerate().filter(|(_, acts)| !**acts) {
            (self.integer[module], self.float[module]) = Default::default();
        }
    }
}

/// Decides what every module does in one control step.
pub trait Policy: Sync {
    /// The actions of all modules for one step, without exploration; yaw and pitch torque as a fraction of the limit, the environment
    /// clips. `memories` go on by a step: hand over the same ones for all steps of an episode, new ones at its start. `noise` differs from step
    /// to step, for those that act at random. `attention` gets the weights, row-major, if there are any.
    fn act(
        &self,
        view: &View,
        noise: u64,
        memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        attention: Option<&mut Vec<f32>>,
    );
}

impl<P: Policy + ?Sized> Policy for &P {
    fn act(
        &self,
        view: &View,
        noise: u64,
        memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        attention: Option<&mut Vec<f32>>,
    ) {
        (**self).act(view, noise, memories, actions, attention);
    }
}

/// Room for the actions of all modules: zeros.
pub(crate) fn still(view: &View, actions: &mut Vec<[f32; 2]>) {
    actions.clear();
    actions.resize(view.observations.len(), [0.0; 2]);
}

/// The frozen integer policy, as the modules run it.
impl Policy for Image<'_> {
    fn act(
        &self,
        view: &View,
        _noise: u64,
        memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        attention: Option<&mut Vec<f32>>,
    ) {
        still(view, actions);
        memories.follow(view);
        let modules = actions.len();
        let steps = memories.integer.iter_mut().zip(&view.observations);
        let encoded: Vec<Encoded> = steps.map(|(memory, observation)| self.encode(memory, observation)).collect();
        let mut latents = [Latent::default(); MAX_MODULES];
        for (slot, e) in latents.iter_mut().zip(&encoded) {
            *slot = e.latent;
        }
        let mut rows = attention;
        if let Some(rows) = rows.as_deref_mut() {
            rows.clear();
        }
        for (module, own) in encoded.iter().enumerate() {
            let mut weights = [0u16; MAX_MODULES];
            actions[module] = Image::act(self, own, &latents, view.heard[module], Some(&mut weights), module);
            if let Some(rows) = rows.as_deref_mut() {
                rows.extend(weights[..modules].iter().map(|&w| f32::from(w) / 32767.0));
            }
        }
    }
}

/// All torques stay zero. A baseline.
#[derive(Clone, Copy, Debug)]
pub struct Still;

impl Policy for Still {
    fn act(
        &self,
        view: &View,
        _noise: u64,
        _memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        _attention: Option<&mut Vec<f32>>,
    ) {
        still(view, actions);
    }
}

/// A new random torque for each motor and step. A baseline.
#[derive(Clone, Copy, Debug)]
pub struct Random;

impl Policy for Random {
    fn act(
        &self,
        view: &View,
        noise: u64,
        _memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        _attention: Option<&mut Vec<f32>>,
    ) {
        still(view, actions);
        for (index, action) in actions.iter_mut().enumerate() {
            *action = [0, 1].map(|axis| {
                let bits = mix(noise ^ mix((2 * index + axis) as u64));
                (bits >> 40) as f32 / (1u64 << 23) as f32 - 1.0
            });
        }
    }
}
