//! A control policy that is told what the imagination policy imagines (`imagination.told`): two networks, one after the other, in floating point. A variant of
//! the study of imagination ([`crate::study`]); should it win, it would ship both.

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};

use super::float::FloatPolicy;
use crate::environment::View;
use crate::methods::imagination::{DISPLACEMENT, TOLD_INPUTS, tell};
use crate::network::Network;
use crate::policy::{Memories, Policy};
use composer_shared::policy::OUT;

/// Both networks, which take the same numbers of the observation; the weights of what the imagination says itself are zero in its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToldNetworks {
    /// The control policy's.
    pub control: Network,
    /// The imagination policy's.
    pub imagination: Network,
}

impl ToldNetworks {
    /// Says what is wrong with them, if anything is.
    pub fn check(&self) -> Result<()> {
        for (network, outputs) in [(&self.control, OUT), (&self.imagination, DISPLACEMENT)] {
            if network.inputs != TOLD_INPUTS {
                bail!("a network takes {} fields of the observation, {TOLD_INPUTS} were expected", network.inputs);
            }
            network.check_numbers(outputs)?;
        }
        Ok(())
    }
}

/// The policy that they are.
#[derive(Clone, Debug)]
pub struct ToldPolicy {
    control: FloatPolicy,
    imagination: FloatPolicy,
}

impl ToldPolicy {
    /// Of these networks, which have been checked.
    pub fn new(networks: &ToldNetworks) -> Self {
        Self { control: FloatPolicy::new(&networks.control), imagination: FloatPolicy::new(&networks.imagination) }
    }
}

impl Policy for ToldPolicy {
    fn act(
        &self,
        view: &View,
        noise: u64,
        memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        attention: Option<&mut Vec<f32>>,
    ) {
        let mut view = view.clone();
        let means = self.imagination.means(&view);
        tell(&means, &mut view.observations);
        Policy::act(&self.control, &view, noise, memories, actions, attention);
    }
}
