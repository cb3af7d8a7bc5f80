//! The baselines against numbers that their authors' own code computed (`fixtures/README.md`): what the networks put out, densities, losses,
//! gradients and one step of the optimiser.

mod fixture;

use composer_host::methods::layers::{Memory, Packed};
use composer_host::methods::layout::Layout;
use composer_host::methods::mappo::Mappo;
use composer_host::methods::mat::Mat;
use composer_host::methods::mat_dec::MatDec;
use composer_host::methods::normalise::{Forgetting, ValueNorm};
use composer_host::methods::off_policy::td3::{self, Sight};
use composer_host::methods::off_policy::{DeterministicActorCritic, Td3, Td3Settings, Transitions};
use composer_host::methods::on_policy::losses::value_loss;
use composer_host::methods::on_policy::taped::{Taped, TapedNetworks};
use composer_host::methods::on_policy::{
    ActorCritic, Batch, Decisions, Gradient, LossSettings, Part, Teams, Trajectory, Valued,
};
use composer_host::methods::parameters::{Adam, clip_norm};
use composer_host::methods::ppo::Ppo;
use composer_host::methods::smp::Smp;
use composer_host::methods::tensors::{Weights, floats};
use fixture::{Fixture, near, same};

/// Tolerances of the fixtures: outputs and losses by their largest number, gradients, and weights after a step by the learning rate.
const OUTPUT: f32 = 1e-5;
const GRADIENT: f32 = 1e-4;
const STEP: f32 = 5e-3;

/// Networks with the parameters of a fixture.
fn networks<N: TapedNetworks>(fixture: &Fixture, networks: N) -> Taped<N> {
    let [actor, critic] = networks.layouts();
    Taped::new(networks, parameters(fixture, &actor.followed_by(&critic)))
}

fn parameters(fixture: &Fixture, layout: &Layout) -> Vec<f32> {
    layout.entries().iter().flat_map(|entry| fixture.get(&format!("param.{}", entry.name))).collect()
}

/// All modules of all teams hear each other.
fn heard(teams: usize, modules: usize) -> Vec<u64> {
    vec![(1 << modules) - 1; teams * modules]
}

/// Means, values and densities of given actions, `[rows, 2]`.
fn scored<N: TapedNetworks>(
    networks: &Taped<N>,
    observations: &[f32],
    actions: &[f32],
    modules: usize,
) -> [Vec<f32>; 3] {
    let teams = observations.len() / 40 / modules;
    let (heard, modules) = (heard(teams, modules), vec![modules; teams]);
    networks.evaluate(Teams { observations, privileged: &[], heard: &heard, modules: &modules }, actions)
}

/// The entropies of the actions.
fn entropies<N: TapedNetworks>(networks: &Taped<N>) -> Vec<f32> {
    networks.log_sigma().iter().map(|l| l + 1.418_938_5).collect()
}

/// What a policy draws with this noise, and the densities of that.
fn drawn(networks: &impl ActorCritic, observations: &[f32], noise: &[f32], modules: usize) -> [Vec<f32>; 2] {
    let (mut actions, mut densities) = (Vec::new(), Vec::new());
    let teams = observations.len() / 40 / modules;
    let (heard, modules) = (heard(teams, modules), vec![modules; teams]);
    let seen = Teams { observations, privileged: &[], heard: &heard, modules: &modules };
    networks.sample(seen, noise, &mut Default::default(), &mut actions, &mut densities);
    [actions, densities]
}

/// A batch of the fixture's update, with the value norm that it leaves.
fn batch(fixture: &Fixture, observations: &str, actions: &str, modules: usize) -> Batch {
    let observations = fixture.get(observations);
    let rows = observations.len() / 40;
    Batch {
        modules: vec![modules; rows / modules],
        observations,
        heard: heard(rows / modules, modules),
        weights: vec![1.0 / rows as f32; rows],
        actions: fixture.get(actions),
        ..Batch::default()
    }
}

/// The value norm of a fixture after its update, checked on the way.
fn value_norm(fixture: &Fixture) -> ValueNorm {
    let mut norm = ValueNorm::new(Forgetting::Minibatches);
    norm.update(&fixture.get("upd.in.valuenorm_warmup_returns"));
    let state = |norm: &ValueNorm, when: &str| {
        let names = ["running_mean", "running_mean_sq", "debiasing_term"];
        if !fixture.has(&format!("upd.valuenorm_{when}.running_mean")) {
            return;
        }
        for (found, name) in norm.numbers().into_iter().zip(names) {
            let expected = f64::from(fixture.get(&format!("upd.valuenorm_{when}.{name}"))[0]);
            assert!((found - expected).abs() < 1e-3 * expected.abs(), "{when} {name}: {found}, {expected}");
        }
    };
    state(&norm, "before");
    norm.update(&fixture.get("upd.in.returns"));
    state(&norm, "after");
    norm
}

/// Gradients of both parts over a batch.
fn gradients<N: TapedNetworks>(
    networks: &Taped<N>,
    [actor, critic]: [&Layout; 2],
    batch: &Batch,
    loss: LossSettings,
) -> [Gradient; 2] {
    let mut sums = [Gradient::default(), Gradient::default()];
    sums[0].clear(actor.len());
    sums[1].clear(critic.len());
    let [of_actor, of_critic] = &mut sums;
    networks.gradient(batch, loss, &mut Default::default(), Some(of_actor), Some(of_critic));
    sums
}

/// Compares a gradient, entry by entry, with those of the fixture that it holds. Returns how many numbers there were.
fn compare_gradient(fixture: &Fixture, prefix: &str, layout: &Layout, gradient: &[f32]) -> usize {
    let mut compared = 0;
    for entry in layout.entries() {
        let name = format!("{prefix}.{}", entry.name);
        if fixture.has(&name) {
            let expected = fixture.get(&name);
            // Keys' biases have none in exact arithmetic.
            near(&name, &gradient[entry.range()], &expected, GRADIENT);
            compared += expected.len();
        }
    }
    assert!(compared > layout.len() / 8, "{compared} of {}", layout.len());
    compared
}

/// Clips, makes one step of Adam and compares the weights that the fixture holds. Returns the norm before clipping.
fn compare_step(
    fixture: &Fixture,
    layout: &Layout,
    gradient: &[f32],
    limit: f32,
    rate: f32,
    prefix: &str,
) -> (f32, Vec<f32>) {
    let mut weights = parameters(fixture, layout);
    let mut gradient = gradient.to_vec();
    let norm = clip_norm(&mut gradient, limit);
    let mut adam = Adam::new(weights.len(), 1e-5);
    adam.step(&mut weights, &gradient, rate);
    let mut compared = 0;
    for entry in layout.entries() {
        let name = format!("{prefix}.{}", entry.name);
        // A key's bias has no gradient but rounding, which Adam makes steps of.
        if fixture.has(&name) && !name.ends_with("key.bias") {
            let expected = fixture.get(&name);
            let largest = expected.iter().fold(0.0f32, |a, b| a.max(b.abs()));
            near(&name, &weights[entry.range()], &expected, STEP * rate + 1.2e-7 * largest);
            compared += 1;
        }
    }
    assert!(compared > 5);
    (norm, weights)
}

/// What MAT and MAT_dec have in common.
fn mat_family<N: TapedNetworks>(fixture: &Fixture, method: N) {
    let networks = networks(fixture, method.clone());
    let scored = |observations: &[f32], actions: &[f32], modules| scored(&networks, observations, actions, modules);
    let (observations, actions) = (fixture.get("in.obs"), fixture.get("in.actions"));
    let [means, values, densities] = scored(&observations, &actions, 8);
    same("action_mean", &means, &fixture.get("out.action_mean"), OUTPUT);
    same("action_std", &networks.sigma(), &fixture.get("out.action_std"), OUTPUT);
    same("values", &values, &fixture.get("out.values"), OUTPUT);
    same("log_probs", &densities, &fixture.get("out.log_probs"), OUTPUT);
    let entropy = entropies(&networks);
    same("entropy", &entropy, &fixture.get("out.entropy")[..2], OUTPUT);
    // The means, one after the other, and with noise; scored in one pass they have the densities that they were drawn with.
    let [deterministic, of_deterministic] = drawn(&networks, &observations, &[0.0; 48], 8);
    same("ar_det.actions", &deterministic, &fixture.get("ar_det.actions"), OUTPUT);
    same("ar_det.log_probs", &of_deterministic, &fixture.get("ar_det.log_probs"), OUTPUT);
    let [sampled, of_sampled] = drawn(&networks, &observations, &fixture.get("ar_smp.noise"), 8);
    same("ar_smp.actions", &sampled, &fixture.get("ar_smp.actions"), OUTPUT);
    same("ar_smp.log_probs", &of_sampled, &fixture.get("ar_smp.log_probs"), OUTPUT);
    same("scored", &scored(&observations, &sampled, 8)[2], &of_sampled, OUTPUT);
    for modules in [6, 11] {
        let of = |name: &str| fixture.get(&format!("n{modules}.{name}"));
        let [_, values, densities] = scored(&of("in.obs"), &of("in.actions"), modules);
        same("values", &values, &of("out.values"), OUTPUT);
        same("log_probs", &densities, &of("out.log_probs"), OUTPUT);
        let [deterministic, _] = drawn(&networks, &of("in.obs"), &vec![0.0; 4 * modules], modules);
        same("ar_det.actions", &deterministic, &of("ar_det.actions"), OUTPUT);
    }

    let mut norm = value_norm(fixture);
    let mut batch = batch(fixture, "in.obs", "in.actions", 8);
    batch.log_probabilities = fixture.get("upd.in.old_log_probs");
    batch.advantages = fixture.get("upd.in.advantages");
    batch.values = fixture.get("upd.in.value_preds");
    batch.targets = fixture.get("upd.in.returns").iter().map(|r| norm.normalise(*r)).collect();
    let loss = LossSettings { clip: 0.05, entropy: 0.001, team_weight: 1.0 / 3.0 };
    let layouts = method.layouts();
    let [sum, _] = gradients(&networks, layouts.each_ref(), &batch, loss);
    let layout = networks.layout();
    let step = |step: usize, name: &str| f64::from(fixture.get(&format!("upd.step{step}.{name}"))[0]);
    let close = |name: &str, found: f64, expected: f64, tolerance: f64| {
        assert!((found - expected).abs() < tolerance * expected.abs().max(0.1), "{name}: {found}, {expected}");
    };
    close("policy_loss", sum.policy_loss, step(1, "policy_loss"), 1e-5);
    close("value_loss", sum.value_loss, step(1, "value_loss"), 1e-5);
    let total = sum.policy_loss + sum.value_loss - 0.001 * f64::from((entropy[0] + entropy[1]) / 2.0);
    close("total_loss", total, step(1, "total_loss"), 1e-5);
    assert_eq!(compare_gradient(fixture, "upd.grad", layout, &sum.gradient), layout.len());
    let (norm_before, weights) = compare_step(fixture, layout, &sum.gradient, 0.5, 5e-5, "upd.after1");
    close("grad_norm", f64::from(norm_before), step(1, "grad_norm"), 1e-4);
    assert!(sum.clipped > 0.3 && sum.clipped < 0.7, "{}", sum.clipped);

    // What a second update on the same batch begins with, the normaliser carried on: loosely, as ratios cross the clip.
    let mut after = networks.clone();
    after.load(Part::Actor, &weights);
    norm.update(&fixture.get("upd.in.returns"));
    batch.targets = fixture.get("upd.in.returns").iter().map(|r| norm.normalise(*r)).collect();
    let [sum, _] = gradients(&after, layouts.each_ref(), &batch, loss);
    close("step 2 policy_loss", sum.policy_loss, step(2, "policy_loss"), 1e-3);
    close("step 2 value_loss", sum.value_loss, step(2, "value_loss"), 1e-3);
}

#[test]
fn mat_is_its_authors() {
    mat_family(&Fixture::load("mat"), Mat);
}

#[test]
fn mat_dec_is_its_authors() {
    mat_family(&Fixture::load("mat_dec"), MatDec);
}

#[test]
fn mappo_is_its_authors() {
    let fixture = Fixture::load("mappo");
    let method = Mappo::on_policy(8);
    let networks = networks(&fixture, method.clone());
    let [means, values, densities] = scored(&networks, &fixture.get("in.obs"), &fixture.get("in.actions"), 8);
    same("action_mean", &means, &fixture.get("out.action_mean"), OUTPUT);
    same("action_std", &networks.sigma(), &fixture.get("out.action_std"), OUTPUT);
    same("values", &values, &fixture.get("out.values"), OUTPUT);
    let joint: Vec<f32> = densities.chunks(2).map(|pair| pair[0] + pair[1]).collect();
    same("log_probs", &joint, &fixture.get("out.log_probs"), OUTPUT);
    let entropy: f32 = entropies(&networks).iter().sum();
    same("entropy", &[entropy], &fixture.get("out.entropy_mean"), OUTPUT);
    let [_, of_mode] = drawn(&networks, &fixture.get("in.obs"), &[0.0; 48], 8);
    same("mode_log_probs", &of_mode, &fixture.get("out.mode_log_probs"), OUTPUT);

    let norm = value_norm(&fixture);
    let mut batch = batch(&fixture, "in.obs", "in.actions", 8);
    batch.log_probabilities = fixture.get("upd.in.old_log_probs");
    batch.advantages = fixture.get("upd.in.advantages");
    batch.values = fixture.get("upd.in.value_preds");
    batch.targets = fixture.get("upd.in.returns").iter().map(|r| norm.normalise(*r)).collect();
    let loss = LossSettings { clip: 0.2, entropy: 0.01, team_weight: 1.0 / 3.0 };
    let [actor, critic] = method.layouts();
    let [of_actor, of_critic] = gradients(&networks, [&actor, &critic], &batch, loss);
    same("policy_loss", &[of_actor.policy_loss as f32], &fixture.get("upd.clean.policy_loss"), 2e-5);
    same("value_loss", &[of_critic.value_loss as f32], &fixture.get("upd.clean.value_loss"), 2e-5);
    assert_eq!(compare_gradient(&fixture, "upd.clean.grad", &actor, &of_actor.gradient), actor.len());
    assert_eq!(compare_gradient(&fixture, "upd.grad", &critic, &of_critic.gradient), critic.len());
    let (norm, _) = compare_step(&fixture, &actor, &of_actor.gradient, 10.0, 5e-4, "upd.after1");
    same("actor_grad_norm", &[norm], &fixture.get("upd.clean.actor_grad_norm"), 1e-4);
    let (norm, _) = compare_step(&fixture, &critic, &of_critic.gradient, 10.0, 5e-4, "upd.after1");
    same("critic_grad_norm", &[norm], &fixture.get("upd.clean.critic_grad_norm"), 1e-4);
}

#[test]
fn mappo_for_torques_is_harls() {
    let fixture = Fixture::load("mappo_harl");
    let method = Mappo::harl(8);
    let valuing_teams = networks(&fixture, method.clone());
    let [means, values, densities] = scored(&valuing_teams, &fixture.get("in.obs"), &fixture.get("in.actions"), 8);
    same("action_mean", &means, &fixture.get("out.action_mean"), OUTPUT);
    same("action_std", &valuing_teams.sigma(), &fixture.get("out.action_std"), OUTPUT);
    same("values", &values, &fixture.get("out.values"), OUTPUT);
    same("log_probs", &densities, &fixture.get("out.log_probs"), OUTPUT);

    let norm = value_norm(&fixture);
    let mut of_teams = batch(&fixture, "in.obs", "in.actions", 8);
    let old = fixture.get("upd.in.old_log_probs");
    of_teams.log_probabilities = old.chunks(2).map(|pair| pair[0] + pair[1]).collect();
    of_teams.values = fixture.get("upd.in.value_preds");
    of_teams.targets = fixture.get("upd.in.returns").iter().map(|r| norm.normalise(*r)).collect();
    of_teams.advantages = vec![0.0; 3];
    let loss = LossSettings { clip: 0.1, entropy: 0.0, team_weight: 1.0 / 3.0 };
    let [actor, critic] = method.layouts();
    let [_, of_critic] = gradients(&valuing_teams, [&actor, &critic], &of_teams, loss);
    // Its fixture has an advantage for every module, a team's value or not.
    let mut of_modules = method;
    of_modules.valued = Valued::Module;
    let valuing_modules = networks(&fixture, of_modules);
    let of_modules = Batch {
        advantages: fixture.get("upd.in.advantages"),
        values: vec![0.0; 24],
        targets: vec![0.0; 24],
        ..of_teams.clone()
    };
    let [of_actor, _] = gradients(&valuing_modules, [&actor, &critic], &of_modules, loss);
    same("policy_loss", &[of_actor.policy_loss as f32], &fixture.get("upd.policy_loss"), 2e-5);
    same("value_loss", &[of_critic.value_loss as f32], &fixture.get("upd.value_loss"), 2e-5);
    compare_gradient(&fixture, "upd.grad", &actor, &of_actor.gradient);
    let mut compared = 0;
    for entry in critic.entries() {
        let name = format!("upd.grad.{}", entry.name);
        if fixture.has(&name) {
            near(&name, &of_critic.gradient[entry.range()], &fixture.get(&name), GRADIENT);
            compared += 1;
        }
    }
    assert!(compared > 10);
    let norm = |gradient: &Gradient| clip_norm(&mut gradient.gradient.clone(), 10.0);
    same("actor_grad_norm", &[norm(&of_actor)], &fixture.get("upd.actor_grad_norm"), 1e-4);
    same("critic_grad_norm", &[norm(&of_critic)], &fixture.get("upd.critic_grad_norm"), 1e-4);
}

#[test]
fn ppo_is_cleanrls_with_padding() {
    let fixture = Fixture::load("ppo_padded");
    let method = Ppo { modules: 11 };
    let networks = networks(&fixture, method);
    // The original is naive about padding: to it the robot has eleven modules, three of which see zeros.
    let alive = fixture.get("in.obs_of_live_modules");
    let observations: Vec<f32> = alive.chunks(8 * 40).flat_map(|team| [team, &[0.0; 3 * 40]].concat()).collect();
    let actions = fixture.get("in.actions");
    let [means, values, densities] = scored(&networks, &observations, &actions, 11);
    same("action_mean", &means, &fixture.get("out.action_mean"), OUTPUT);
    same("action_std", &networks.sigma(), &fixture.get("out.action_std"), OUTPUT);
    same("values", &values, &fixture.get("out.values"), OUTPUT);
    let joint: Vec<f32> = densities.chunks(22).map(|team| team.iter().sum()).collect();
    same("log_probs", &joint, &fixture.get("out.log_probs"), OUTPUT);
    let entropy: f32 = entropies(&networks).iter().sum();
    same("entropy", &[entropy], &fixture.get("out.entropy")[..1], OUTPUT);
    // Eight modules and padding put out the same as the first eight of those eleven.
    let [shorter, _, _] = scored(&networks, &alive, &vec![0.0; 24 * 16], 8);
    let expected: Vec<f32> = fixture.get("out.action_mean").chunks(22).flat_map(|team| team[..16].to_vec()).collect();
    same("eight modules", &shorter, &expected, OUTPUT);

    let advantages = fixture.get("upd.in.advantages");
    let mean = advantages.iter().sum::<f32>() / 24.0;
    let std = (advantages.iter().map(|a| (a - mean).powi(2)).sum::<f32>() / 23.0).sqrt() + 1e-8;
    let old = fixture.get("upd.in.old_log_probs");
    let batch = Batch {
        modules: vec![11; 24],
        heard: heard(24, 11),
        weights: vec![1.0 / (24.0 * 11.0); 24 * 11],
        observations,
        actions,
        // Of the whole team: in the sum over its modules it does not matter whose it is.
        log_probabilities: old.iter().flat_map(|l| [&[*l][..], &[0.0; 10]].concat()).collect(),
        advantages: advantages.iter().map(|a| (a - mean) / std).collect(),
        values: fixture.get("upd.in.old_values"),
        targets: fixture.get("upd.in.returns"),
        ..Batch::default()
    };
    let loss = LossSettings { clip: 0.2, entropy: 0.01, team_weight: 1.0 / 24.0 };
    let [sum, _] = gradients(&networks, method.layouts().each_ref(), &batch, loss);
    same("pg_loss", &[sum.policy_loss as f32], &fixture.get("upd.pg_loss"), 1e-4);
    same("v_loss", &[sum.value_loss as f32], &fixture.get("upd.v_loss"), 2e-5);
    same("approx_kl", &[sum.kl as f32], &fixture.get("upd.approx_kl"), 1e-4);
    same("clipfrac", &[sum.clipped as f32], &fixture.get("upd.clipfrac"), 1e-5);
    compare_gradient(&fixture, "upd.grad", networks.layout(), &sum.gradient);
    let (norm, _) = compare_step(&fixture, networks.layout(), &sum.gradient, 0.5, 3e-4, "upd.after1");
    same("grad_norm", &[norm], &fixture.get("upd.grad_norm"), 1e-4);
}

#[test]
fn advantages_are_the_authors() {
    let fixture = Fixture::load("gae_valuenorm");
    let of = |name: &str| fixture.get(&format!("gae.{name}"));
    let (rewards, values, finals) = (of("in.rewards"), of("in.values"), of("in.final_values"));
    let (alive, in_time) = (of("in.not_done_after_step"), of("in.not_truncated_after_step"));
    let [gamma, lambda] = [0, 1].map(|i| of("in.gamma_lambda")[i]);
    let mut norm = ValueNorm::new(Forgetting::Minibatches);
    norm.update(&of("in.valuenorm_warmup_returns"));
    for (scale, norm) in [("plain", None), ("valuenorm", Some(norm))] {
        let real = |v: f32| norm.map_or(v, |norm| norm.denormalise(v));
        if norm.is_some() {
            let denormalised: Vec<f32> = values.iter().map(|v| real(*v)).collect();
            same("denormalised", &denormalised, &of("valuenorm.denormalised_values"), OUTPUT);
        }
        for (ends, time_limits) in [("all_terminal", false), ("bootstrap_truncated", true)] {
            for env in 0..2 {
                let done = |t: usize| alive[t * 2 + env] == 0.0;
                let cut = |t: usize| time_limits && in_time[t * 2 + env] == 0.0;
                let trajectory = Trajectory {
                    modules: 2,
                    rewards: (0..12).map(|t| rewards[t * 2 + env]).collect(),
                    terminated: (0..12).map(|t| done(t) && !cut(t)).collect(),
                    truncated: (0..12).map(cut).collect(),
                    ..Trajectory::default()
                };
                let row = |all: &[f32], t: usize| [0, 1].map(|m| real(all[(t * 2 + env) * 2 + m]));
                let of_steps: Vec<f32> = (0..12).flat_map(|t| row(&values, t)).collect();
                let mut of_finals: Vec<f32> = (0..12).filter(|t| cut(*t)).flat_map(|t| row(&finals, t)).collect();
                of_finals.extend(row(&values, 12));
                let mut decisions = Decisions { rewards: trajectory.rewards.clone(), ..Decisions::default() };
                decisions.estimate(&trajectory, &of_steps, &of_finals, 2, gamma, lambda);
                for (found, name) in [(&decisions.advantages, "advantages"), (&decisions.returns, "returns")] {
                    let all = of(&format!("{scale}.{ends}.{name}"));
                    let expected: Vec<f32> = (0..12).flat_map(|t| [0, 1].map(|m| all[(t * 2 + env) * 2 + m])).collect();
                    same(&format!("{scale} {ends} {name} {env}"), found, &expected, OUTPUT);
                }
            }
        }
    }
}

#[test]
fn the_value_norm_is_the_authors() {
    let fixture = Fixture::load("gae_valuenorm");
    let (batches, probe) = (fixture.get("valuenorm.in.batches"), fixture.get("valuenorm.in.probe"));
    let mut norm = ValueNorm::new(Forgetting::Minibatches);
    for k in 0..7 {
        if k > 0 {
            norm.update(&batches[(k - 1) * 32..k * 32]);
        }
        let row = |name: &str| fixture.get(&format!("valuenorm.out.{name}"))[k * 7..(k + 1) * 7].to_vec();
        let normalised: Vec<f32> = probe.iter().map(|x| norm.normalise(*x)).collect();
        let denormalised: Vec<f32> = probe.iter().map(|x| norm.denormalise(*x)).collect();
        // The original sums in single precision.
        same(&format!("normalised {k}"), &normalised, &row("normalized"), 2e-4);
        same(&format!("denormalised {k}"), &denormalised, &row("denormalized"), 2e-4);
    }
}

#[test]
fn hubers_loss_acts_on_both_sides() {
    let fixture = Fixture::load("gae_valuenorm");
    let expected = fixture.get("huber.out.delta10");
    let one_sided = fixture.get("huber.out.delta10_as_in_mat");
    let weights = Weights::new(&Layout::default(), &[]);
    for (i, error) in fixture.get("huber.in.error").into_iter().enumerate() {
        let batch = Batch { values: vec![-error], targets: vec![0.0], ..Batch::default() };
        let values = weights.tensor(&[-error], [1, 1]);
        let to_tensor = |numbers: &[f32], shape: [usize; 2]| weights.tensor(numbers, shape);
        let loss = value_loss(values, &batch, (Some(10.0), Valued::Team), 0.2, 1.0, to_tensor);
        same(&format!("error {error}"), &floats(loss), &expected[i..=i], OUTPUT);
        // Where MAT's differs, it costs nothing.
        assert!(one_sided[i] == expected[i] || one_sided[i] == 0.0);
    }
}

/// What SMP's networks put out on a chain.
fn smp_outputs(fixture: &Fixture, td3: &Td3<Smp>, prefix: &str, values: [&str; 2], modules: usize) {
    let of = |name: &str| fixture.get(&format!("{prefix}{name}"));
    let (state, networks) = (of("in.state"), &td3.networks);
    let heard = heard(state.len() / 40 / modules, modules);
    let (sight, mut memory) = (Sight { modules, observations: &state, heard: &heard }, Memory::default());
    let actions = td3::act(networks, &td3.actor(), sight, &mut memory);
    same("actor_action", &actions, &of("out.actor_action"), OUTPUT);
    let found = td3::values(networks, &td3.critic(), sight, &of("in.action"), &mut memory);
    for (found, name) in found.iter().zip(values) {
        same(name, found, &of(name), OUTPUT);
    }
}

#[test]
fn smp_is_its_authors() {
    let fixture = Fixture::load("smp");
    let networks = Smp { widths: [40, 30] };
    let layouts = networks.layouts();
    let read = |suffix: &str| {
        ["actor", "critic"].map(|network| {
            let layout = &layouts[usize::from(network == "critic")];
            let name = |entry: &str| format!("param.{network}{suffix}.{entry}");
            layout.entries().iter().flat_map(|entry| fixture.get(&name(&entry.name))).collect::<Vec<f32>>()
        })
    };
    let mut td3 = Td3::new(networks, read(""));
    td3.targets = read("_target");
    smp_outputs(&fixture, &td3, "", ["perlimb.out.q1", "perlimb.out.q2"], 8);
    for modules in [5, 11] {
        smp_outputs(&fixture, &td3, &format!("n{modules}."), ["out.q1_perlimb", "out.q2_perlimb"], modules);
    }
    let target = Packed::new(&layouts[0], &td3.targets[0]);
    let next = fixture.get("in.next_state");
    let sight = Sight { modules: 8, observations: &next, heard: &heard(3, 8) };
    let actions = td3::act(&networks, &target, sight, &mut Memory::default());
    same("target_policy_action", &actions, &fixture.get("out.target_policy_action"), OUTPUT);

    let batch = Transitions {
        modules: 8,
        observations: fixture.get("in.state"),
        heard: heard(3, 8),
        actions: fixture.get("in.action"),
        rewards: fixture.get("in.reward"),
        done: fixture.get("in.done"),
        next_observations: fixture.get("in.next_state"),
        next_heard: heard(3, 8),
    };
    let settings = Td3Settings {
        environments: 1,
        rollout_steps: 1,
        updates_per_step: 1.0,
        batch: 3,
        replay: 3,
        random_steps: 0,
        gamma: 0.99,
        tau: 0.046,
        learning_rate: 5e-4,
        exploration: 0.0,
        target_noise: 0.4,
        target_noise_clip: 0.5,
        delay: 2,
    };
    let stats = td3.update(&batch, &fixture.get("in.target_noise"), &settings, true);
    let of = |name: &str| fixture.get(&format!("perlimb.upd.{name}"));
    same("target_q", &stats.targets, &of("target_q"), OUTPUT);
    same("critic_loss", &[stats.critic_loss as f32], &of("critic_loss"), OUTPUT);
    same("actor_loss", &[stats.actor_loss.unwrap() as f32], &of("actor_loss"), OUTPUT);
    let gradients = [("actor", &stats.actor_gradient), ("critic", &stats.critic_gradient)];
    for ((name, gradient), layout) in gradients.into_iter().zip(&layouts) {
        let compared = compare_gradient(&fixture, &format!("perlimb.upd.grad.{name}"), layout, gradient);
        assert_eq!(compared, layout.len());
        let norm = clip_norm(&mut gradient.clone(), f32::INFINITY);
        same(name, &[norm], &of(&format!("grad_norm_total.{name}")), 1e-4);
    }
    let after = [("", &td3.online), ("_target", &td3.targets)];
    let mut compared = 0;
    for (suffix, networks) in after {
        for ((name, parameters), layout) in ["actor", "critic"].into_iter().zip(networks).zip(&layouts) {
            for entry in layout.entries() {
                let key = format!("perlimb.upd.after.{name}{suffix}.{}", entry.name);
                if fixture.has(&key) {
                    near(&key, &parameters[entry.range()], &fixture.get(&key), STEP * 5e-4 + 1e-7);
                    compared += 1;
                }
            }
        }
    }
    assert!(compared > 40, "{compared}");
}
