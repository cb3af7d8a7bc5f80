//! Baselines whose modules act alone, as networks that modules can run.
//!
//! The image of a module has room for two layers of 64 with tanh behind them ([`crate::network`]), not for the layer normalisation, ReLU and GELU
//! of MAPPO and MAT_dec. What goes onto the bus of these is therefore a network of the image's form that has learnt what theirs does
//! (distillation), in rounds: theirs drives the first, the learner itself the others, and theirs says each time what it would have done
//! (DAgger; Ross, Gordon and Bagnell 2011), so that the learner knows its way where its own errors lead it. What that costs is told beside
//! what the integers cost ([`parity`]).

use composer_shared::observation::BASE;
use composer_shared::policy::{CLIP, EMBED, HIDDEN, OUT, Policy as Image};
use rand::RngExt;

use crate::eval::{Trial, run_episode};
use crate::freeze::Parity;
use crate::methods::composer::float::FloatPolicy;
use crate::methods::layers::{Memory, Packed, Tape};
use crate::methods::layout::{Activation, Layout, Scheme};
use crate::methods::normalise::{Frozen, Running};
use crate::methods::parameters::Adam;
use crate::methods::random::{Stream, stream};
use crate::network::Network;
use crate::policy::{Memories, Policy};

/// Rounds of episodes.
const ROUNDS: usize = 8;
/// Updates after each round.
pub const UPDATES: usize = 4000;
/// Samples of an update.
const BATCH: usize = 512;
/// Learning rate at the start; it falls to 0 over all updates.
const RATE: f32 = 2e-3;
/// Seed of weights and minibatches.
const SEED: u64 = 0xd157;

/// What modules saw, and what was done or would have been.
#[derive(Clone, Debug, Default)]
struct Samples {
    observations: Vec<[f32; BASE]>,
    actions: Vec<[f32; OUT]>,
}

/// What `knows` would do in the episodes of a trial that `drives` drives, in their order.
fn ask(trial: &Trial, drives: &dyn Policy, knows: &dyn Policy) -> Samples {
    // An episode at a time: its samples stay together, whatever the number of threads.
    let episodes = trial.run(|env, seed, faults| {
        let (mut samples, mut actions) = (Samples::default(), Vec::new());
        run_episode(env, drives, seed, faults, |_, view| {
            knows.act(view, 0, &mut Memories::default(), &mut actions, None);
            samples.observations.extend(view.observations.iter().filter_map(|o| o.first_chunk::<BASE>()));
            samples.actions.extend(actions.iter().map(|torques| torques.map(|torque| torque.clamp(-1.0, 1.0))));
        });
        samples
    });
    let mut all = Samples::default();
    for Samples { observations, actions } in episodes {
        all.observations.extend(observations);
        all.actions.extend(actions);
    }
    all
}

fn layout() -> Layout {
    let mut layout = Layout::default();
    let gain = Scheme::Orthogonal(1.0);
    layout.linear("encoder", BASE, EMBED, gain);
    layout.linear("hidden", EMBED, HIDDEN, gain);
    layout.linear("output", HIDDEN, OUT, Scheme::Orthogonal(0.01));
    layout
}

/// A network without attention that has learnt to act as `policy` does, whose modules act on their own observations alone, in so many updates a
/// round. Every round has the episodes of the trial.
pub fn distil(policy: &dyn Policy, trial: &Trial, updates: usize) -> Network {
    let mut samples = ask(trial, policy, policy);
    let mut statistics = Running::new(BASE);
    samples.observations.iter().for_each(|observation| statistics.push(observation));
    let normal = Frozen::with_clip(&statistics, CLIP);
    let layout = layout();
    let mut parameters = layout.initial(&mut stream(SEED, Stream::Weights, 0, 0));
    let (mut adam, mut weights) = (Adam::new(parameters.len(), 1e-8), Packed::new(&layout, &parameters));
    let (mut memory, mut packed, mut gradient) = (Memory::default(), Vec::new(), Vec::new());
    let mut inputs = Vec::with_capacity(BATCH * BASE);
    for round in 0..ROUNDS {
        if round > 0 {
            let network = network(&layout, &parameters, &statistics);
            let trial = Trial { seed: crate::methods::mix(trial.seed ^ round as u64), ..*trial };
            let Samples { observations, actions } = ask(&trial, &FloatPolicy::new(&network), policy);
            samples.observations.extend(observations);
            samples.actions.extend(actions);
        }
        let mut rng = stream(SEED, Stream::Shuffle, round as u64, 0);
        for update in 0..updates {
            let chosen: Vec<usize> =
                (0..BATCH).map(|_| rng.random_range(0..samples.observations.len().max(1))).collect();
            inputs.clear();
            chosen.iter().for_each(|at| normal.apply(&samples.observations[*at], &mut inputs));
            let mut t = Tape::new(&mut memory);
            let w = t.learning(&weights);
            let x = t.input(&inputs, BASE);
            let x = t.activated(w, "encoder", Activation::Tanh, x);
            let x = t.activated(w, "hidden", Activation::Tanh, x);
            let y = t.linear(w, "output", x);
            // Half the mean square of the difference between clipped torques.
            let wanted = chosen.iter().flat_map(|at| samples.actions[*at]);
            let of = |(found, wanted): (f32, f32)| {
                let beyond = found.abs() > 1.0 && found * wanted >= 1.0;
                if beyond { 0.0 } else { (found - wanted) / (BATCH * OUT) as f32 }
            };
            let of_y: Vec<f32> = t.numbers(y).into_iter().zip(wanted).map(of).collect();
            packed.clear();
            packed.resize(weights.len(), 0.0);
            t.backward(&[(y, &of_y)], &mut packed);
            gradient.clear();
            gradient.resize(parameters.len(), 0.0);
            weights.unpack(&packed, &mut gradient);
            let done = (round * updates + update) as f32 / (ROUNDS * updates) as f32;
            adam.step(&mut parameters, &gradient, RATE * (1.0 - done));
            weights.load(&parameters);
        }
    }
    network(&layout, &parameters, &statistics)
}

fn network(layout: &Layout, parameters: &[f32], statistics: &Running) -> Network {
    let mut network = Network::zeros(false);
    (network.mean, network.std) = (statistics.mean(), statistics.std());
    let of = |name: &str| &parameters[layout.range(name)];
    network.encoder.weights.copy_from_slice(of("encoder.weight"));
    // Behind the embedding there are the columns of a context that it does not have.
    let rows = network.hidden.weights.chunks_exact_mut(network.hidden.inputs);
    rows.zip(of("hidden.weight").chunks_exact(EMBED)).for_each(|(row, from)| row[..EMBED].copy_from_slice(from));
    network.output.weights.copy_from_slice(of("output.weight"));
    network.encoder.bias.copy_from_slice(of("encoder.bias"));
    network.hidden.bias.copy_from_slice(of("hidden.bias"));
    network.output.bias.copy_from_slice(of("output.bias"));
    network
}

/// Difference between what `policy` does and what the image does, in episodes that `policy` drives.
pub fn parity(policy: &dyn Policy, image: &Image, trial: &Trial) -> Parity {
    let [exact, integer] = [policy, image as &dyn Policy].map(|knows| ask(trial, policy, knows).actions);
    let pairs = exact.as_flattened().iter().zip(integer.as_flattened());
    Parity::of(pairs.map(|(exact, integer)| (exact - integer).abs()).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use composer_shared::policy::Task;

    use super::*;
    use crate::eval::healthy;
    use crate::freeze::freeze;
    use crate::methods::baselines::learner;
    use crate::methods::mat_dec::MatDec;
    use crate::methods::normalise::Forgetting;
    use crate::methods::on_policy::ActorCritic;
    use crate::methods::{Method, TrainedPolicy};
    use crate::paper::protocol;

    #[test]
    fn a_module_that_acts_alone_is_learnt_and_frozen() {
        let config = protocol::settings(Task::GoalReaching, Method::MatDec, 1, None);
        let learner = learner(MatDec, 5, Forgetting::Off, 1e-3);
        let TrainedPolicy::Weights(mut saved) = learner.networks.policy(&[], &[]) else { panic!("it has weights") };
        // Its outputs are small in the beginning; trained ones are not.
        let [layout, _] = crate::methods::on_policy::taped::TapedNetworks::layouts(&MatDec);
        saved.parameters[layout.range("decoder.mlp.7.weight")].iter_mut().for_each(|w| *w *= 40.0);
        let policy = saved.policy();
        let env = Arc::new(config.evaluation());
        let trial = Trial { config: &env, episodes: 3, seed: 1, faults: &healthy, threads: 2 };
        let network = distil(&*policy, &trial, 400);
        network.check().unwrap();
        assert_eq!(network, distil(&*policy, &Trial { threads: 1, ..trial }, 400));
        let image = freeze(&network, &config.meta(), &trial.observations(&*policy)).unwrap();
        let image = Image::parse(&image).unwrap();
        let held_out = Trial { seed: 2, ..trial };
        let size = ask(&held_out, &*policy, &*policy).actions;
        let size = size.as_flattened().iter().map(|a| a * a).sum::<f32>() / size.as_flattened().len() as f32;
        let Parity { rms, max, .. } = parity(&*policy, &image, &held_out);
        assert!(size.sqrt() > 0.2, "{size}");
        assert!(rms < 0.15 * size.sqrt(), "{rms} of {}, at most {max}", size.sqrt());
    }
}
