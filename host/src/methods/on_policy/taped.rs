//! Networks on a [`Tape`] with MAT's losses: a method of that family says how its networks compute, the rest of an [`ActorCritic`] is here.
//! What [`autodiff`](super::autodiff) is for burn's tensors, several times faster.

use std::ops::Range;
use std::sync::Arc;

use composer_shared::observation::BASE;

use super::collect::ACTIONS;
use super::losses::LOG_ROOT_TAU;
use super::{ActorCritic, Batch, Gradient, LossSettings, Part, Ratio, Teams, Valued};
use crate::methods::TrainedPolicy;
use crate::methods::layers::{Matrix, Memory, Network, Packed, Query, Tape};
use crate::methods::tensors::Layout;

/// Name of the parameters that the standard deviations of the actions are made of: sigma = 0.5 sigmoid(log_std).
pub const LOG_STD: &str = "decoder.log_std";
/// Beyond this error the loss of the values is linear.
const HUBER: f32 = 10.0;
/// Teams whose gradient is computed together: their numbers stay in the cache on the way back.
const TEAMS: usize = 16;

/// What some teams see, on a tape.
#[derive(Clone, Debug)]
pub struct Seen<'a> {
    /// Modules of each team.
    pub modules: &'a [usize],
    /// Observations, `[rows, BASE]`.
    pub observations: Matrix,
    /// Whom each row hears.
    pub heard: Arc<[Query]>,
    /// The same without the modules that come later.
    pub before: Arc<[Query]>,
}

impl<'a> Seen<'a> {
    fn new(t: &mut Tape, observations: &[f32], heard: &[u64], modules: &'a [usize]) -> Self {
        let mut first = 0;
        let mut queries = [Vec::with_capacity(heard.len()), Vec::with_capacity(heard.len())];
        for n in modules {
            for (i, heard) in heard[first..first + n].iter().enumerate() {
                queries[0].push(Query { first, n: *n, heard: *heard });
                queries[1].push(Query { first, n: *n, heard: heard & (u64::MAX >> (63 - i)) });
            }
            first += n;
        }
        let [heard, before] = queries.map(Into::into);
        Self { modules, observations: t.input(observations, BASE), heard, before }
    }
}

/// The networks of a method, as functions of their weights.
pub trait TapedNetworks: Clone + Send + Sync + 'static {
    /// All parameters, [`LOG_STD`] among them.
    fn layout(&self) -> Layout;

    /// Means of the actions and the values, given the actions that were taken: `[rows, ACTIONS]` and `[rows, 1]`.
    fn evaluate(&self, t: &mut Tape, w: Network, seen: &Seen, actions: &[f32]) -> [Matrix; 2];

    /// The values alone.
    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix;

    /// Means and actions, both `[rows, ACTIONS]`, with standard normal `noise`.
    fn act(&self, t: &mut Tape, w: Network, seen: &Seen, noise: &[f32], sigma: [f32; ACTIONS]) -> [Vec<f32>; 2];

    /// What evaluation runs.
    fn policy(&self, parameters: &[f32]) -> TrainedPolicy;
}

/// Actions around their means.
pub fn draw(means: &[f32], noise: &[f32], sigma: [f32; ACTIONS]) -> Vec<f32> {
    means.iter().zip(noise).zip(sigma.iter().cycle()).map(|((mean, noise), sigma)| mean + noise * sigma).collect()
}

/// Logarithm of the density of an action, and its distance from the mean in standard deviations.
fn log_density(action: f32, mean: f32, sigma: f32) -> [f32; 2] {
    let distance = (action - mean) / sigma;
    [distance * distance * -0.5 - sigma.ln() - LOG_ROOT_TAU, distance]
}

/// An [`ActorCritic`] out of [`TapedNetworks`]: one optimiser for everything, a ratio for each action, a value for each module.
#[derive(Clone, Debug)]
pub struct Taped<N> {
    networks: N,
    layout: Layout,
    parameters: Vec<f32>,
    weights: Packed,
}

/// Working memory of one thread.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    memory: Memory,
    /// Gradient over the packed parameters.
    packed: Vec<f32>,
}

impl<N: TapedNetworks> Taped<N> {
    /// Networks with these parameters.
    pub fn new(networks: N, parameters: Vec<f32>) -> Self {
        let layout = networks.layout();
        Self { weights: Packed::new(&layout, &parameters), networks, layout, parameters }
    }

    /// The layout of the parameters.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    fn log_std(&self) -> &[f32] {
        &self.parameters[self.layout.range(LOG_STD)]
    }

    /// Standard deviations of the actions.
    pub fn sigma(&self) -> [f32; ACTIONS] {
        std::array::from_fn(|i| 0.5 / (1.0 + (-self.log_std()[i]).exp()))
    }

    /// Means of the actions and the values, given the actions that were taken, and the logarithms of their densities.
    pub fn evaluate(&self, teams: Teams, actions: &[f32]) -> [Vec<f32>; 3] {
        let mut memory = Memory::default();
        let mut t = Tape::new(&mut memory);
        let w = t.network(&self.weights);
        let seen = Seen::new(&mut t, teams.observations, teams.heard, teams.modules);
        let [means, values] = self.networks.evaluate(&mut t, w, &seen, actions).map(|x| t.numbers(x));
        let densities = self.densities(actions, &means).collect();
        [means, values, densities]
    }

    fn densities<'a>(&self, actions: &'a [f32], means: &'a [f32]) -> impl Iterator<Item = f32> + use<'a, N> {
        let sigma = self.sigma();
        actions.iter().zip(means).enumerate().map(move |(i, (a, mean))| log_density(*a, *mean, sigma[i % ACTIONS])[0])
    }

    /// Adds the losses of some rows to `sum`, with their gradient over log_std. Returns those over means and values.
    fn losses(
        &self,
        batch: &Batch,
        rows: Range<usize>,
        [means, values]: [&[f32]; 2],
        loss: LossSettings,
        sum: &mut Gradient,
    ) -> [Vec<f32>; 2] {
        let (mut of_means, mut of_values) = (vec![0.0; means.len()], vec![0.0; values.len()]);
        let (sigma, of_log_std) = (self.sigma(), &mut sum.gradient[self.layout.range(LOG_STD)]);
        for (i, row) in rows.enumerate() {
            let weight = batch.weights[row];
            if weight == 0.0 {
                continue;
            }
            for j in 0..ACTIONS {
                let (at, taken) = (i * ACTIONS + j, row * ACTIONS + j);
                let [density, distance] = log_density(batch.actions[taken], means[at], sigma[j]);
                let log_ratio = density - batch.log_probabilities[taken];
                let exact = f64::from(log_ratio).exp();
                let (ratio, advantage) = (exact as f32, batch.advantages[row]);
                let (gain, held) = (ratio * advantage, ratio.clamp(1.0 - loss.clip, 1.0 + loss.clip) * advantage);
                sum.policy_loss -= f64::from(gain.min(held) * weight);
                sum.kl += f64::from(weight) * (exact - 1.0 - f64::from(log_ratio));
                if (exact - 1.0).abs() > f64::from(loss.clip) {
                    sum.clipped += f64::from(weight) / ACTIONS as f64;
                }
                // Where the clip holds the gain down, nothing is gained by moving.
                let of_density = if gain <= held { -weight * gain } else { 0.0 };
                of_means[at] = of_density * distance / sigma[j];
                // d ln sigma / d log_std = 1 - sigmoid(log_std); the entropy is ln sigma and a constant, its mean over the actions counts.
                let of_log_sigma = of_density * (distance * distance - 1.0) - loss.entropy * weight / ACTIONS as f32;
                of_log_std[j] += of_log_sigma * (1.0 - 2.0 * sigma[j]);
            }
            let (value, old, target) = (values[i], batch.values[row], batch.targets[row]);
            let held = old + (value - old).clamp(-loss.clip, loss.clip);
            // Half the square up to a size, then on with its slope there.
            let huber = |error: f32| {
                let within = error.abs().min(HUBER);
                0.5 * within * within + (error.abs() - within) * HUBER
            };
            let [free, clipped] = [value, held].map(|value| huber(value - target));
            sum.value_loss += f64::from(free.max(clipped) * weight);
            of_values[i] =
                if free >= clipped || held == value { weight * (value - target).clamp(-HUBER, HUBER) } else { 0.0 };
        }
        [of_means, of_values]
    }
}

impl<N: TapedNetworks> ActorCritic for Taped<N> {
    type Scratch = Scratch;

    const TOGETHER: usize = 8;

    fn block(&self) -> usize {
        64
    }

    fn outputs(&self) -> usize {
        ACTIONS
    }

    fn ratio(&self) -> Ratio {
        Ratio::Dimension
    }

    fn valued(&self) -> Valued {
        Valued::Module
    }

    fn log_sigma(&self) -> Vec<f32> {
        crate::methods::mat::log_of_sigma(self.log_std())
    }

    fn load(&mut self, part: Part, parameters: &[f32]) {
        // The critic's part has none.
        if part == Part::Actor {
            self.parameters.copy_from_slice(parameters);
            self.weights.load(parameters);
        }
    }

    fn sample(
        &self,
        teams: Teams,
        noise: &[f32],
        scratch: &mut Scratch,
        actions: &mut Vec<f32>,
        log_probabilities: &mut Vec<f32>,
    ) {
        let mut t = Tape::new(&mut scratch.memory);
        let w = t.network(&self.weights);
        let seen = Seen::new(&mut t, teams.observations, teams.heard, teams.modules);
        let [means, drawn] = self.networks.act(&mut t, w, &seen, noise, self.sigma());
        log_probabilities.extend(self.densities(&drawn, &means));
        actions.extend(drawn);
    }

    fn values(&self, teams: Teams, scratch: &mut Scratch, values: &mut Vec<f32>) {
        let mut row = 0;
        for modules in teams.modules.chunks(TEAMS) {
            let rows = row..row + modules.iter().sum::<usize>();
            let mut t = Tape::new(&mut scratch.memory);
            let w = t.network(&self.weights);
            let observations = &teams.observations[rows.start * BASE..rows.end * BASE];
            let seen = Seen::new(&mut t, observations, &teams.heard[rows.clone()], modules);
            let of_rows = self.networks.values(&mut t, w, &seen);
            values.extend(t.numbers(of_rows));
            row = rows.end;
        }
    }

    fn gradient(
        &self,
        batch: &Batch,
        loss: LossSettings,
        scratch: &mut Scratch,
        actor: Option<&mut Gradient>,
        _critic: Option<&mut Gradient>,
    ) {
        let Some(sum) = actor else { return };
        let Scratch { memory, packed } = scratch;
        packed.clear();
        packed.resize(self.weights.len(), 0.0);
        let mut row = 0;
        for modules in batch.modules.chunks(TEAMS) {
            let rows = row..row + modules.iter().sum::<usize>();
            let mut t = Tape::new(memory);
            let w = t.learning(&self.weights);
            let observations = &batch.observations[rows.start * BASE..rows.end * BASE];
            let seen = Seen::new(&mut t, observations, &batch.heard[rows.clone()], modules);
            let actions = &batch.actions[rows.start * ACTIONS..rows.end * ACTIONS];
            let [means, values] = self.networks.evaluate(&mut t, w, &seen, actions);
            let found = [t.numbers(means), t.numbers(values)];
            let [of_means, of_values] =
                self.losses(batch, rows.clone(), found.each_ref().map(Vec::as_slice), loss, sum);
            t.backward(&[(means, &of_means), (values, &of_values)], packed);
            row = rows.end;
        }
        self.weights.unpack(packed, &mut sum.gradient);
    }

    fn policy(&self, _mean: &[f32], _std: &[f32]) -> TrainedPolicy {
        self.networks.policy(&self.parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::mat::Mat;
    use crate::methods::mat_dec::MatDec;
    use crate::methods::on_policy::losses;
    use crate::methods::random::{Stream, numbers, stream};
    use crate::methods::tensors::{Weights, scalar};

    /// Teams of several lengths, where not everyone hears everyone and not everyone acts.
    fn batch(modules: &[usize]) -> Batch {
        let rows: usize = modules.iter().sum();
        Batch {
            modules: modules.to_vec(),
            observations: numbers(rows * BASE, 1),
            heard: modules.iter().flat_map(|n| (0..*n).map(move |i| ((1 << n) - 1) & !(2 << i) | 1 << i)).collect(),
            weights: (0..rows).map(|row| if row % 5 == 3 { 0.0 } else { 0.1 }).collect(),
            actions: numbers(rows * ACTIONS, 2).iter().map(|a| 0.4 * a).collect(),
            log_probabilities: numbers(rows * ACTIONS, 3).iter().map(|l| -0.3 + 0.1 * l).collect(),
            advantages: numbers(rows, 4),
            // Beyond Huber's bend, some.
            targets: numbers(rows, 5).iter().map(|t| 8.0 * t).collect(),
            values: numbers(rows, 6).iter().map(|v| 0.2 * v).collect(),
            ..Batch::default()
        }
    }

    fn learner<N: TapedNetworks>(networks: N) -> Taped<N> {
        let parameters = networks.layout().initial(&mut stream(7, Stream::Weights, 2, 0));
        // The outputs of attention are small in the beginning: with noise, everything counts.
        let moved = parameters.iter().zip(numbers(parameters.len(), 8)).map(|(p, noise)| p + 0.1 * noise).collect();
        Taped::new(networks, moved)
    }

    const LOSS: LossSettings = LossSettings { clip: 0.05, entropy: 0.01, team_weight: 0.2 };

    fn gradient<N: TapedNetworks>(networks: &Taped<N>, batch: &Batch) -> Gradient {
        let mut sum = Gradient::default();
        sum.clear(networks.layout().len());
        networks.gradient(batch, LOSS, &mut Scratch::default(), Some(&mut sum), None);
        sum
    }

    #[test]
    fn losses_and_their_gradients_are_those_of_the_tensors() {
        let networks = learner(MatDec);
        let (batch, modules) = (batch(&[4, 4, 4]), 4);
        let [means, values] = [numbers(12 * ACTIONS, 11), numbers(12, 12)].map(|n| n.iter().map(|x| 0.4 * x).collect());
        let [means, values]: [Vec<f32>; 2] = [means, values];
        let mut sum = Gradient::default();
        sum.clear(networks.layout().len());
        let [of_means, of_values] = networks.losses(&batch, 0..12, [&means, &values], LOSS, &mut sum);

        let mut layout = Layout::default();
        for name in ["means", "values", "log_std"] {
            layout.vector(name, [24, 12, 2][usize::from(name == "values") + 2 * usize::from(name == "log_std")], 0.0);
        }
        let all = [&means[..], &values, networks.log_std()].concat();
        let w = Weights::tracked(&layout, &all);
        let to_tensor = |numbers: &[f32], shape: [usize; 2]| w.tensor(numbers, shape);
        let sigma = burn::tensor::activation::sigmoid(w.get("log_std")) * 0.5;
        let actions = to_tensor(&batch.actions, [12, ACTIONS]);
        let densities = losses::log_density(actions, w.get("means").reshape([12, ACTIONS]), sigma.clone());
        let over = (Ratio::Dimension, Valued::Module);
        let policy = losses::policy_loss(densities, &batch, modules, over, LOSS.clip, LOSS.team_weight, to_tensor);
        let values = w.get("values").reshape([12, 1]);
        let over = (Some(HUBER), Valued::Module);
        let of_value = losses::value_loss(values, &batch, over, LOSS.clip, LOSS.team_weight, to_tensor);
        let bonus = losses::entropy(sigma).mean_dim(1) * to_tensor(&batch.weights, [12, 1]);
        let total = policy.loss.clone() - bonus.sum() * LOSS.entropy + of_value.clone();
        for (found, expected) in [
            (sum.policy_loss, scalar(&policy.loss.inner())),
            (sum.value_loss, scalar(&of_value.inner())),
            (sum.kl, policy.kl),
            (sum.clipped, policy.clipped),
        ] {
            assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{found} {expected}");
        }
        let expected = w.gradients(&layout, &total);
        let found = [&of_means[..], &of_values, &sum.gradient[networks.layout().range(LOG_STD)]].concat();
        assert!(policy.clipped > 0.1 && of_values.contains(&0.0));
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{found} {expected}");
        }
    }

    /// Along some directions the loss grows as its gradient says.
    fn slopes<N: TapedNetworks>(networks: &Taped<N>) {
        let batch = batch(&[3, 5, 5, 1]);
        let at = |parameters: Vec<f32>| {
            let moved = Taped::new(networks.networks.clone(), parameters);
            let sum = gradient(&moved, &batch);
            let entropy: f32 = moved.sigma().iter().map(|s| s.ln() / ACTIONS as f32).sum();
            let acting: f32 = batch.weights.iter().sum();
            sum.policy_loss + sum.value_loss - f64::from(LOSS.entropy * acting * entropy)
        };
        let gradient = gradient(networks, &batch).gradient;
        for entry in networks.layout().entries() {
            // Each entry along its own gradient.
            let own = &gradient[entry.range()];
            let norm = own.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            if norm < 1e-2 {
                continue;
            }
            let step = (1e-3 / norm) as f32;
            let [up, down] = [step, -step].map(|step| {
                let mut parameters = networks.parameters().to_vec();
                parameters[entry.range()].iter_mut().zip(own).for_each(|(p, g)| *p += step * g);
                at(parameters)
            });
            let slope = (up - down) / 2e-3;
            assert!((slope / norm - 1.0).abs() < 3e-2, "{}: {slope} instead of {norm}", entry.name);
        }
    }

    #[test]
    fn gradients_are_slopes() {
        slopes(&learner(Mat));
        slopes(&learner(MatDec));
    }

    /// A batch at once, each of its teams alone, and what was drawn module by module: the same bits.
    fn alone_and_together<N: TapedNetworks>(networks: &Taped<N>) {
        let modules = [3, 8, 8, 1, 11];
        let batch = batch(&modules);
        let teams =
            Teams { observations: &batch.observations, privileged: &[], heard: &batch.heard, modules: &batch.modules };
        let (mut actions, mut densities, mut scratch) = (Vec::new(), Vec::new(), Scratch::default());
        let noise = numbers(batch.rows() * ACTIONS, 9);
        networks.sample(teams, &noise, &mut scratch, &mut actions, &mut densities);
        let [_, values, scored] = networks.evaluate(teams, &actions);
        assert_eq!(densities, scored);
        let mut of_rollout = Vec::new();
        networks.values(teams, &mut scratch, &mut of_rollout);
        assert_eq!(of_rollout, values);
        let (mut row, mut ones) = (0, [Vec::new(), Vec::new()]);
        for n in &modules {
            let rows = row..row + n;
            let teams = Teams {
                observations: &batch.observations[rows.start * BASE..rows.end * BASE],
                privileged: &[],
                heard: &batch.heard[rows.clone()],
                modules: &[*n],
            };
            let [actions, densities] = &mut ones;
            let noise = &noise[rows.start * ACTIONS..rows.end * ACTIONS];
            networks.sample(teams, noise, &mut scratch, actions, densities);
            row = rows.end;
        }
        assert_eq!(ones, [actions, densities]);
    }

    #[test]
    fn what_a_team_does_depends_on_nobody_else() {
        alone_and_together(&learner(Mat));
        alone_and_together(&learner(MatDec));
    }
}
