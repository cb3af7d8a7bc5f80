//! Networks on a [`Tape`] with the clipped losses of PPO's family: a method says how its networks compute and what its ratio is taken over, the
//! rest of an [`ActorCritic`] is here. What [`autodiff`](super::autodiff) is for burn's tensors, several times faster.

use std::sync::Arc;

use composer_shared::observation::BASE;

use super::collect::ACTIONS;
use super::losses::{LOG_ROOT_TAU, ValueLoss};
use super::{ActorCritic, Batch, Gradient, LossSettings, Part, Ratio, Teams, Valued};
use crate::methods::TrainedPolicy;
use crate::methods::layers::{Matrix, Memory, Network, Packed, Query, Tape};
use crate::methods::layout::Layout;

/// Name of the parameters that MAT and MAT_dec make the standard deviations of the actions of.
pub const LOG_STD: &str = "decoder.log_std";
/// Teams whose gradient is computed together: their numbers stay in the cache on the way back.
const TEAMS: usize = 16;

/// What some teams see, on a tape.
#[derive(Clone, Debug)]
pub struct Seen<'a> {
    /// Modules of each team.
    pub modules: &'a [usize],
    /// Observations, `[rows, BASE]`.
    pub observations: Matrix,
    /// The same as numbers.
    pub numbers: &'a [f32],
    /// Whom each row hears.
    pub heard: Arc<[Query]>,
    /// The same without the modules that come later.
    pub before: Arc<[Query]>,
}

impl<'a> Seen<'a> {
    fn new(t: &mut Tape, numbers: &'a [f32], heard: &[u64], modules: &'a [usize]) -> Self {
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
        Self { modules, observations: t.input(numbers, BASE), numbers, heard, before }
    }

    /// What the heads hear and the observations of each team, `[modules, BASE]`.
    pub fn teams(&self) -> impl Iterator<Item = (u64, &'a [f32])> {
        let mut first = 0;
        self.modules.iter().map(move |n| {
            let rows = first..first + n;
            first = rows.end;
            (self.heard[rows.start].heard, &self.numbers[rows.start * BASE..rows.end * BASE])
        })
    }
}

/// What a log_std stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deviation {
    /// sigma = 0.5 sigmoid(log_std)
    Squashed,
    /// sigma = exp(log_std)
    Exponential,
}

impl Deviation {
    /// The standard deviation.
    fn sigma(self, log_std: f32) -> f32 {
        match self {
            Deviation::Squashed => 0.5 / (1.0 + (-log_std).exp()),
            Deviation::Exponential => log_std.exp(),
        }
    }

    /// Its logarithm.
    fn log_sigma(self, log_std: f32) -> f32 {
        match self {
            Deviation::Squashed => 0.5f32.ln() - (1.0 + (-log_std).exp()).ln(),
            Deviation::Exponential => log_std,
        }
    }

    /// How that grows with log_std, where the standard deviation is `sigma`.
    fn slope(self, sigma: f32) -> f32 {
        match self {
            Deviation::Squashed => 1.0 - 2.0 * sigma,
            Deviation::Exponential => 1.0,
        }
    }
}

/// The networks of a method, as functions of their weights. What is not said is as in MAT.
pub trait TapedNetworks: Clone + Send + Sync + 'static {
    /// The actor's parameters and the critic's, or all and none where one optimiser steps both; no name is in both.
    fn layouts(&self) -> [Layout; 2];

    /// Name of the actor's parameters that the standard deviations are made of, and how: one an action, the same for all modules, or one for each
    /// action of each module.
    fn log_std(&self) -> (&'static str, Deviation) {
        (LOG_STD, Deviation::Squashed)
    }

    /// What the ratio is taken over.
    fn ratio(&self) -> Ratio {
        Ratio::Dimension
    }

    /// What is valued.
    fn valued(&self) -> Valued {
        Valued::Module
    }

    /// The loss of the values.
    fn value_loss(&self) -> ValueLoss {
        ValueLoss { coefficient: 1.0, huber: Some(10.0) }
    }

    /// Whether entropies are summed over the actions of a row (else their mean counts), and over the rows of a team.
    fn entropy_sums(&self) -> [bool; 2] {
        [false, false]
    }

    /// The most modules that it can decide for, if there is a limit.
    fn most_modules(&self) -> Option<usize> {
        None
    }

    /// Means of the actions, `[rows, ACTIONS]`, given the actions that were taken, where they matter.
    fn means(&self, t: &mut Tape, w: Network, seen: &Seen, actions: &[f32]) -> Matrix;

    /// The values, `[rows, 1]` or `[teams, 1]`.
    fn values(&self, t: &mut Tape, w: Network, seen: &Seen) -> Matrix;

    /// Means and values, given the actions that were taken.
    fn evaluate(&self, t: &mut Tape, w: Network, seen: &Seen, actions: &[f32]) -> [Matrix; 2] {
        [self.means(t, w, seen, actions), self.values(t, w, seen)]
    }

    /// Means and actions, both `[rows, ACTIONS]`, with standard normal `noise`, where no action depends on another.
    fn act(&self, t: &mut Tape, w: Network, seen: &Seen, noise: &[f32], sigma: &[f32]) -> [Vec<f32>; 2] {
        let means = self.means(t, w, seen, &[]);
        let means = t.numbers(means);
        let mut first = 0;
        let of_team = |n: &usize| {
            let all = first..first + n * ACTIONS;
            first = all.end;
            draw(&means[all.clone()], &noise[all], sigma)
        };
        let actions = seen.modules.iter().flat_map(of_team).collect();
        [means, actions]
    }

    /// What evaluation runs, out of all parameters and the statistics of the observations.
    fn policy(&self, parameters: &[f32], mean: &[f32], std: &[f32]) -> TrainedPolicy;
}

/// Actions of the first modules of a team around their means.
pub fn draw(means: &[f32], noise: &[f32], sigma: &[f32]) -> Vec<f32> {
    means.iter().zip(noise).zip(sigma.iter().cycle()).map(|((mean, noise), sigma)| mean + noise * sigma).collect()
}

/// Logarithm of the density of an action, and its distance from the mean in standard deviations.
fn log_density(action: f32, mean: f32, sigma: f32) -> [f32; 2] {
    let distance = (action - mean) / sigma;
    [distance * distance * -0.5 - sigma.ln() - LOG_ROOT_TAU, distance]
}

/// An [`ActorCritic`] out of [`TapedNetworks`].
#[derive(Clone, Debug)]
pub struct Taped<N> {
    networks: N,
    /// The layout of all parameters, the actor's part first.
    layout: Layout,
    /// Numbers in the actor's part.
    of_actor: usize,
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
    /// Networks with these parameters, the actor's part first.
    pub fn new(networks: N, parameters: Vec<f32>) -> Self {
        let [actor, critic] = networks.layouts();
        let of_actor = actor.len();
        let layout = actor.followed_by(&critic);
        Self { weights: Packed::new(&layout, &parameters), networks, layout, of_actor, parameters }
    }

    /// The layout of all parameters, the actor's part first.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// All parameters.
    pub fn parameters(&self) -> &[f32] {
        &self.parameters
    }

    fn log_std(&self) -> &[f32] {
        &self.parameters[self.layout.range(self.networks.log_std().0)]
    }

    /// Standard deviations of the actions: of one module, or of all one behind the other.
    pub fn sigma(&self) -> Vec<f32> {
        let (_, deviation) = self.networks.log_std();
        self.log_std().iter().map(|log_std| deviation.sigma(*log_std)).collect()
    }

    /// Means of the actions and the values, given the actions that were taken, and the logarithms of their densities.
    pub fn evaluate(&self, teams: Teams, actions: &[f32]) -> [Vec<f32>; 3] {
        let mut memory = Memory::default();
        let mut t = Tape::new(&mut memory);
        let w = t.network(&self.weights);
        let seen = Seen::new(&mut t, teams.observations, teams.heard, teams.modules);
        let [means, values] = self.networks.evaluate(&mut t, w, &seen, actions).map(|x| t.numbers(x));
        let densities = self.densities(actions, &means, teams.modules);
        [means, values, densities]
    }

    /// Logarithms of the densities of actions, `[rows, ACTIONS]`.
    fn densities(&self, actions: &[f32], means: &[f32], modules: &[usize]) -> Vec<f32> {
        let sigma = self.sigma();
        let each = modules.iter().flat_map(|n| sigma.iter().cycle().take(n * ACTIONS));
        actions.iter().zip(means).zip(each).map(|((a, mean), sigma)| log_density(*a, *mean, *sigma)[0]).collect()
    }

    /// Adds the losses of some teams, whose first is team `first` and row `row` of the batch, to `sum`, with their gradient over log_std. Returns
    /// those over means and values.
    fn losses(
        &self,
        batch: &Batch,
        (first, row): (usize, usize),
        modules: &[usize],
        [means, values]: [&[f32]; 2],
        loss: LossSettings,
        sum: &mut Gradient,
    ) -> [Vec<f32>; 2] {
        let (mut of_means, mut of_values) = (vec![0.0; means.len()], vec![0.0; values.len()]);
        let ((name, deviation), sigma) = (self.networks.log_std(), self.sigma());
        let of_log_std = self.layout.range(name);
        let (over, valued) = (self.networks.ratio(), self.networks.valued());
        let mut start = 0;
        for (i, n) in modules.iter().enumerate() {
            let (team, rows) = (first + i, row + start..row + start + n);
            let acts = |at: &usize| batch.weights[*at] > 0.0;
            // Of the row's action j: its place among the means, and its density.
            let place = |at: usize, j: usize| (at - row) * ACTIONS + j;
            let density = |at: usize, j: usize| {
                let sigma = sigma[((at - rows.start) * ACTIONS + j) % sigma.len()];
                log_density(batch.actions[at * ACTIONS + j], means[place(at, j)], sigma)[0]
            };
            let advantage = |at: usize| match valued {
                Valued::Module => batch.advantages[at],
                Valued::Team => batch.advantages[team],
            };
            // The gradient over each density.
            let mut of_densities = vec![[0.0; ACTIONS]; *n];
            match over {
                Ratio::Dimension => {
                    for at in rows.clone().filter(acts) {
                        of_densities[at - rows.start] = std::array::from_fn(|j| {
                            let log_ratio = density(at, j) - batch.log_probabilities[at * ACTIONS + j];
                            let weight = [batch.weights[at], 1.0 / ACTIONS as f32];
                            clipped(log_ratio, advantage(at), weight, loss.clip, sum)
                        });
                    }
                }
                Ratio::Module => {
                    for at in rows.clone().filter(acts) {
                        let joint: f32 = (0..ACTIONS).map(|j| density(at, j)).sum();
                        let log_ratio = joint - batch.log_probabilities[at];
                        let each = clipped(log_ratio, advantage(at), [batch.weights[at], 1.0], loss.clip, sum);
                        of_densities[at - rows.start] = [each; ACTIONS];
                    }
                }
                Ratio::Team => {
                    let of_row =
                        |at: usize| (0..ACTIONS).map(|j| density(at, j)).sum::<f32>() - batch.log_probabilities[at];
                    let log_ratio = rows.clone().filter(acts).map(of_row).sum();
                    let advantage = rows.clone().map(advantage).sum::<f32>() / *n as f32;
                    let each = clipped(log_ratio, advantage, [loss.team_weight, 1.0], loss.clip, sum);
                    rows.clone().filter(acts).for_each(|at| of_densities[at - rows.start] = [each; ACTIONS]);
                }
            }
            let [over_actions, over_rows] = self.networks.entropy_sums();
            for at in rows.clone().filter(acts) {
                let weight = if over_rows { loss.team_weight } else { batch.weights[at] };
                let bonus = loss.entropy * weight / if over_actions { 1.0 } else { ACTIONS as f32 };
                for j in 0..ACTIONS {
                    let of_density = of_densities[at - rows.start][j];
                    let own = ((at - rows.start) * ACTIONS + j) % sigma.len();
                    let [_, distance] = log_density(batch.actions[at * ACTIONS + j], means[place(at, j)], sigma[own]);
                    of_means[place(at, j)] = of_density * distance / sigma[own];
                    // The entropy is ln sigma and a constant.
                    let of_log_sigma = of_density * (distance * distance - 1.0) - bonus;
                    sum.gradient[of_log_std.start + own] += of_log_sigma * deviation.slope(sigma[own]);
                }
            }
            match valued {
                Valued::Module => {
                    for at in rows.clone().filter(acts) {
                        of_values[at - row] = self.of_value(batch, at, values[at - row], batch.weights[at], loss, sum);
                    }
                }
                Valued::Team => of_values[i] = self.of_value(batch, team, values[i], loss.team_weight, loss, sum),
            }
            start += n;
        }
        [of_means, of_values]
    }

    /// Adds the loss of a value, number `at` of the batch. Returns its gradient.
    fn of_value(
        &self,
        batch: &Batch,
        at: usize,
        value: f32,
        weight: f32,
        loss: LossSettings,
        sum: &mut Gradient,
    ) -> f32 {
        let ValueLoss { coefficient, huber } = self.networks.value_loss();
        let limit = huber.unwrap_or(f32::INFINITY);
        let (old, target) = (batch.values[at], batch.targets[at]);
        let held = old + (value - old).clamp(-loss.clip, loss.clip);
        // Half the square up to a size, then on with its slope there.
        let of = |error: f32| {
            let within = error.abs().min(limit);
            let beyond = error.abs() - within;
            0.5 * within * within + if beyond > 0.0 { beyond * limit } else { 0.0 }
        };
        let [free, clipped] = [value, held].map(|value| of(value - target));
        sum.value_loss += f64::from(free.max(clipped) * weight);
        let moves = free >= clipped || held == value;
        if moves { coefficient * weight * (value - target).clamp(-limit, limit) } else { 0.0 }
    }
}

/// Adds the clipped loss of one ratio, which weighs `weight`, and in the share of clipped ratios so many times that. Returns the gradient of the loss
/// over the logarithm.
fn clipped(log_ratio: f32, advantage: f32, [weight, share]: [f32; 2], clip: f32, sum: &mut Gradient) -> f32 {
    let exact = f64::from(log_ratio).exp();
    let ratio = exact as f32;
    let (gain, held) = (ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage);
    sum.policy_loss -= f64::from(gain.min(held) * weight);
    sum.kl += f64::from(weight) * (exact - 1.0 - f64::from(log_ratio));
    if (exact - 1.0).abs() > f64::from(clip) {
        sum.clipped += f64::from(weight) * f64::from(share);
    }
    // Where the clip holds the gain down, nothing is gained by moving.
    if gain <= held { -weight * gain } else { 0.0 }
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

    fn most_modules(&self) -> Option<usize> {
        self.networks.most_modules()
    }

    fn ratio(&self) -> Ratio {
        self.networks.ratio()
    }

    fn valued(&self) -> Valued {
        self.networks.valued()
    }

    fn log_sigma(&self) -> Vec<f32> {
        let (_, deviation) = self.networks.log_std();
        self.log_std().iter().map(|log_std| deviation.log_sigma(*log_std)).collect()
    }

    fn load(&mut self, part: Part, parameters: &[f32]) {
        let (actor, critic) = self.parameters.split_at_mut(self.of_actor);
        match part {
            Part::Actor => actor.copy_from_slice(parameters),
            Part::Critic => critic.copy_from_slice(parameters),
        }
        if !parameters.is_empty() {
            self.weights.load(&self.parameters);
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
        let [means, drawn] = self.networks.act(&mut t, w, &seen, noise, &self.sigma());
        let densities = self.densities(&drawn, &means, teams.modules);
        match self.ratio() {
            Ratio::Dimension => log_probabilities.extend(densities),
            Ratio::Module | Ratio::Team => {
                log_probabilities.extend(densities.chunks_exact(ACTIONS).map(|row| row.iter().sum::<f32>()));
            }
        }
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
            let found = self.networks.values(&mut t, w, &seen);
            values.extend(t.numbers(found));
            row = rows.end;
        }
    }

    fn gradient(
        &self,
        batch: &Batch,
        loss: LossSettings,
        scratch: &mut Scratch,
        actor: Option<&mut Gradient>,
        critic: Option<&mut Gradient>,
    ) {
        let Scratch { memory, packed } = scratch;
        packed.clear();
        packed.resize(self.weights.len(), 0.0);
        let mut sum = Gradient::default();
        sum.clear(self.layout.len());
        let (mut team, mut row) = (0, 0);
        for modules in batch.modules.chunks(TEAMS) {
            let rows = row..row + modules.iter().sum::<usize>();
            let mut t = Tape::new(memory);
            let w = t.learning(&self.weights);
            let observations = &batch.observations[rows.start * BASE..rows.end * BASE];
            let seen = Seen::new(&mut t, observations, &batch.heard[rows.clone()], modules);
            let actions = &batch.actions[rows.start * ACTIONS..rows.end * ACTIONS];
            let [means, values] = self.networks.evaluate(&mut t, w, &seen, actions);
            let found = [t.numbers(means), t.numbers(values)];
            let found = found.each_ref().map(Vec::as_slice);
            let [of_means, of_values] = self.losses(batch, (team, row), modules, found, loss, &mut sum);
            t.backward(&[(means, &of_means), (values, &of_values)], packed);
            (team, row) = (team + modules.len(), rows.end);
        }
        self.weights.unpack(packed, &mut sum.gradient);
        sum.hand_over(self.of_actor, actor, critic);
    }

    fn policy(&self, mean: &[f32], std: &[f32]) -> TrainedPolicy {
        self.networks.policy(&self.parameters, mean, std)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::mappo::Mappo;
    use crate::methods::mat::Mat;
    use crate::methods::mat_dec::MatDec;
    use crate::methods::on_policy::losses;
    use crate::methods::ppo::Ppo;
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
            advantages: numbers(rows, 4),
            // Beyond Huber's bend, some.
            targets: numbers(rows, 5).iter().map(|t| 8.0 * t).collect(),
            values: numbers(rows, 6).iter().map(|v| 0.2 * v).collect(),
            ..Batch::default()
        }
    }

    fn learner<N: TapedNetworks>(networks: N) -> Taped<N> {
        let [actor, critic] = networks.layouts();
        let parameters = actor.followed_by(&critic).initial(&mut stream(7, Stream::Weights, 2, 0));
        // The outputs of attention are small in the beginning: with noise, everything counts.
        let moved = parameters.iter().zip(numbers(parameters.len(), 8)).map(|(p, noise)| p + 0.1 * noise).collect();
        Taped::new(networks, moved)
    }

    /// Densities as the batch remembers them: so far from those now.
    fn remembered(now: &[f32], ratio: Ratio, far: f32) -> Vec<f32> {
        let before: Vec<f32> = now.iter().zip(numbers(now.len(), 3)).map(|(now, noise)| now + far * noise).collect();
        match ratio {
            Ratio::Dimension => before,
            Ratio::Module | Ratio::Team => before.chunks_exact(ACTIONS).map(|row| row.iter().sum()).collect(),
        }
    }

    const LOSS: LossSettings = LossSettings { clip: 0.05, entropy: 0.01, team_weight: 0.2 };

    fn gradient<N: TapedNetworks>(networks: &Taped<N>, batch: &Batch) -> Gradient {
        let mut sum = Gradient::default();
        sum.clear(networks.of_actor);
        let mut of_critic = Gradient::default();
        of_critic.clear(networks.layout().len() - networks.of_actor);
        networks.gradient(batch, LOSS, &mut Scratch::default(), Some(&mut sum), Some(&mut of_critic));
        sum.gradient.extend(of_critic.gradient);
        sum
    }

    /// The same losses on burn's tensors.
    fn same_as_tensors(networks: impl TapedNetworks) {
        let networks = learner(networks);
        let (mut batch, modules, teams) = (batch(&[4, 4, 4]), 4, 3);
        let rows = teams * modules;
        let valued = if networks.valued() == Valued::Team { teams } else { rows };
        for numbers in [&mut batch.advantages, &mut batch.values, &mut batch.targets] {
            numbers.truncate(valued);
        }
        let [means, values] = [(rows * ACTIONS, 11), (valued, 12)]
            .map(|(len, seed)| numbers(len, seed).iter().map(|x| 0.4 * x).collect::<Vec<f32>>());
        let now = networks.densities(&batch.actions, &means, &batch.modules);
        batch.log_probabilities = remembered(&now, networks.ratio(), 0.05);
        let mut sum = Gradient::default();
        sum.clear(networks.layout().len());
        let found = [&means[..], &values];
        let [of_means, of_values] = networks.losses(&batch, (0, 0), &[modules; 3], found, LOSS, &mut sum);

        let mut layout = Layout::default();
        for (name, len) in [("means", means.len()), ("values", valued), ("log_std", networks.log_std().len())] {
            layout.vector(name, len, 0.0);
        }
        let w = Weights::tracked(&layout, &[&means[..], &values, networks.log_std()].concat());
        let to_tensor = |numbers: &[f32], shape: [usize; 2]| w.tensor(numbers, shape);
        let ((name, deviation), log_std) = (networks.networks.log_std(), w.get("log_std"));
        let own = log_std.dims()[1];
        let sigma = match deviation {
            Deviation::Squashed => burn::tensor::activation::sigmoid(log_std) * 0.5,
            Deviation::Exponential => log_std.exp(),
        };
        let of_team = sigma.repeat(&[teams * modules * ACTIONS / own.min(modules * ACTIONS), 1]);
        let sigma = of_team.narrow(1, 0, own.min(modules * ACTIONS)).reshape([rows, ACTIONS]);
        let actions = to_tensor(&batch.actions, [rows, ACTIONS]);
        let densities = losses::log_density(actions, w.get("means").reshape([rows, ACTIONS]), sigma.clone());
        let over = (networks.ratio(), networks.valued());
        let policy = losses::policy_loss(densities, &batch, modules, over, LOSS.clip, LOSS.team_weight, to_tensor);
        let ValueLoss { coefficient, huber } = networks.networks.value_loss();
        let values = w.get("values").reshape([valued, 1]);
        let of_value =
            losses::value_loss(values, &batch, (huber, networks.valued()), LOSS.clip, LOSS.team_weight, to_tensor);
        let [over_actions, over_rows] = networks.networks.entropy_sums();
        let weight = |w: &f32| if over_rows && *w > 0.0 { LOSS.team_weight } else { *w };
        let weights: Vec<f32> = batch.weights.iter().map(weight).collect();
        let share = if over_actions { 1.0 } else { 1.0 / ACTIONS as f32 };
        let bonus = losses::entropy(sigma).sum_dim(1) * to_tensor(&weights, [rows, 1]) * share;
        let total = policy.loss.clone() - bonus.sum() * LOSS.entropy + of_value.clone() * coefficient;
        for (found, expected) in [
            (sum.policy_loss, scalar(&policy.loss.inner())),
            (sum.value_loss, scalar(&of_value.inner())),
            (sum.kl, policy.kl),
            (sum.clipped, policy.clipped),
        ] {
            assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{found} {expected}");
        }
        let expected = w.gradients(&layout, &total);
        let found = [&of_means[..], &of_values, &sum.gradient[networks.layout().range(name)]].concat();
        assert!(policy.clipped > 0.1 && of_means.contains(&0.0));
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{found} {expected}");
        }
    }

    #[test]
    fn losses_and_their_gradients_are_those_of_the_tensors() {
        same_as_tensors(MatDec);
        same_as_tensors(Mappo::harl(4));
        same_as_tensors(Mappo::on_policy(4));
        same_as_tensors(Ppo { modules: 4 });
        same_as_tensors(Ppo { modules: 5 });
    }

    /// Along the gradient of each entry the loss grows as it says.
    fn slopes(networks: impl TapedNetworks, modules: &[usize]) {
        let networks = learner(networks);
        let mut batch = batch(modules);
        let teams =
            Teams { observations: &batch.observations, privileged: &[], heard: &batch.heard, modules: &batch.modules };
        let [_, _, now] = networks.evaluate(teams, &batch.actions);
        // Far enough that few ratios cross the clip on the way.
        batch.log_probabilities = remembered(&now, networks.ratio(), 0.3);
        let [over_actions, over_rows] = networks.networks.entropy_sums();
        let at = |parameters: Vec<f32>| {
            let moved = Taped::new(networks.networks.clone(), parameters);
            let (sum, sigma) = (gradient(&moved, &batch), moved.sigma());
            let mut entropy = 0.0;
            let acting = modules.iter().flat_map(|n| 0..*n).zip(&batch.weights).filter(|(_, weight)| **weight > 0.0);
            for (module, weight) in acting {
                let of_row: f32 = (0..ACTIONS).map(|j| sigma[(module * ACTIONS + j) % sigma.len()].ln()).sum();
                let weight = if over_rows { LOSS.team_weight } else { *weight };
                entropy += weight * of_row / if over_actions { 1.0 } else { ACTIONS as f32 };
            }
            let coefficient = f64::from(networks.networks.value_loss().coefficient);
            sum.policy_loss + coefficient * sum.value_loss - f64::from(LOSS.entropy * entropy)
        };
        let (gradient, mut compared) = (gradient(&networks, &batch).gradient, 0);
        for entry in networks.layout().entries() {
            // Each entry along its own gradient.
            let own = &gradient[entry.range()];
            let norm = own.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            if norm < 1e-2 {
                continue;
            }
            // Short where it is steep, so that few ratios cross the clip; else long, against rounding.
            let far = 1e-3 / norm.max(1.0);
            let step = (far / norm) as f32;
            let [up, down] = [step, -step].map(|step| {
                let mut parameters = networks.parameters().to_vec();
                parameters[entry.range()].iter_mut().zip(own).for_each(|(p, g)| *p += step * g);
                at(parameters)
            });
            let slope = (up - down) / (2.0 * far);
            assert!((slope / norm - 1.0).abs() < 3e-2, "{}: {slope} instead of {norm}", entry.name);
            compared += 1;
        }
        assert!(compared > 8, "{compared}");
    }

    #[test]
    fn gradients_are_slopes() {
        let modules = [3, 5, 5, 1];
        slopes(Mat, &modules);
        slopes(MatDec, &modules);
        slopes(Ppo { modules: 6 }, &modules);
        slopes(Mappo::harl(4), &[4; 3]);
        slopes(Mappo::on_policy(4), &[4; 3]);
    }

    /// A batch at once, each of its teams alone, and what was drawn module by module: the same bits.
    fn alone_and_together(networks: impl TapedNetworks, modules: &[usize]) {
        let networks = learner(networks);
        let batch = batch(modules);
        let teams =
            Teams { observations: &batch.observations, privileged: &[], heard: &batch.heard, modules: &batch.modules };
        let (mut actions, mut densities, mut scratch) = (Vec::new(), Vec::new(), Scratch::default());
        let noise = numbers(batch.rows() * ACTIONS, 9);
        networks.sample(teams, &noise, &mut scratch, &mut actions, &mut densities);
        let [_, values, scored] = networks.evaluate(teams, &actions);
        let of_row = |row: &[f32]| row.iter().sum::<f32>();
        let joint = scored.chunks_exact(ACTIONS).map(of_row).collect();
        assert_eq!(densities, if networks.ratio() == Ratio::Dimension { scored } else { joint });
        let mut of_rollout = Vec::new();
        networks.values(teams, &mut scratch, &mut of_rollout);
        assert_eq!(of_rollout, values);
        let (mut row, mut ones) = (0, [Vec::new(), Vec::new()]);
        for n in modules {
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
        let modules = [3, 8, 8, 1, 11];
        alone_and_together(Mat, &modules);
        alone_and_together(MatDec, &modules);
        alone_and_together(Ppo { modules: 11 }, &modules);
        alone_and_together(Mappo::harl(8), &[8; 5]);
        alone_and_together(Mappo::on_policy(8), &[8; 5]);
    }
}
