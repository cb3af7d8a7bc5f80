//! The training loop: collect, learn, log, save, until the steps are used up or somebody presses Ctrl-C.

pub mod checkpoint;
pub mod metrics;
pub mod progress;
pub mod tensorboard;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

use self::checkpoint::Checkpoint;
use self::metrics::Metrics;
use self::progress::Progress;
use crate::methods::ranks::Ranks;
use crate::methods::{Algorithm, MakeEnvironment, Report, TrainConfig, TrainedPolicy, create};

/// What a run came to.
#[derive(Clone, Debug)]
pub struct TrainSummary {
    /// The policy at the end.
    pub policy: TrainedPolicy,
    /// Environment steps taken, those before a resumption included.
    pub steps: u64,
    /// Iterations done.
    pub iterations: u64,
    /// Whether the run was stopped before its end (and can be resumed).
    pub interrupted: bool,
    /// Wall time since the start or the last resumption.
    pub wall: Duration,
    /// What the last evaluation said.
    pub evaluation: Vec<(String, f64)>,
}

/// What goes on beside a run.
#[derive(Clone, Debug, Default)]
pub struct Beside<'a> {
    /// Other runs: its name tells their progress apart.
    pub name: Option<&'a str>,
    /// Other processes that work on the same run.
    pub ranks: Option<Arc<dyn Ranks>>,
}

impl Beside<'_> {
    /// Whether this process does not lead: another one writes what there is to write.
    pub fn follows(&self) -> bool {
        self.ranks.as_ref().is_some_and(|ranks| ranks.rank() > 0)
    }

    /// Whether any of the processes says so.
    fn anybody(&self, says: bool) -> bool {
        match &self.ranks {
            Some(ranks) => ranks.all_gather(&[says.into()]).concat().contains(&1),
            None => says,
        }
    }
}

/// Judges a policy after so many steps; what it returns goes into the metrics under these names.
pub type Evaluate<'a> = &'a mut dyn FnMut(&TrainedPolicy, u64) -> Vec<(String, f64)>;

/// A run between two iterations: a method with its settings, and what it is trained for.
pub struct Trainer {
    config: TrainConfig,
    fingerprint: String,
    algorithm: Box<dyn Algorithm>,
}

impl Trainer {
    /// A run that has not begun.
    pub fn new(config: &TrainConfig, make: MakeEnvironment, fingerprint: &str) -> Result<Self> {
        let algorithm = create(config, make)?;
        Ok(Self { config: config.clone(), fingerprint: fingerprint.into(), algorithm })
    }

    /// A run as a checkpoint has it. The settings must be those of the checkpoint; only how long it runs, how often it evaluates and
    /// saves, and the threads may differ.
    pub fn resume(
        checkpoint: &Checkpoint,
        config: &TrainConfig,
        make: MakeEnvironment,
        fingerprint: &str,
    ) -> Result<Self> {
        if checkpoint.fingerprint != fingerprint {
            bail!(
                "the checkpoint is of another robot or task: it was trained for `{}`, this is `{fingerprint}`",
                checkpoint.fingerprint
            );
        }
        let mut was = config_of(checkpoint)?;
        was.total_steps = config.total_steps;
        was.evaluate_every = config.evaluate_every;
        was.evaluation_episodes = config.evaluation_episodes;
        was.checkpoint_seconds = config.checkpoint_seconds;
        was.threads = config.threads;
        // What it began with is behind it, wherever that lies by now.
        was.start.clone_from(&config.start);
        if was != *config {
            let (was, is) = (settings_of(&was)?, settings_of(config)?);
            let changed = was.iter().filter(|setting| !is.contains(setting));
            let changed: Vec<_> = changed.map(|(key, value)| format!("{key} (it was {value})")).collect();
            bail!("a resumed run keeps its settings, but these were changed: {}", changed.join(", "));
        }
        let mut trainer = Self::new(config, make, fingerprint)?;
        trainer.algorithm.load(&checkpoint.state, make)?;
        Ok(trainer)
    }

    /// All that [`Trainer::resume`] needs.
    pub fn checkpoint(&self) -> Result<Checkpoint> {
        Ok(Checkpoint {
            config: toml::to_string(&self.config).context("the settings cannot be written as TOML")?,
            fingerprint: self.fingerprint.clone(),
            state: self.algorithm.save(),
        })
    }

    /// Collects and learns once.
    pub fn iterate(&mut self) -> Result<Report> {
        self.algorithm.iterate()
    }

    /// The policy as it is now.
    pub fn policy(&self) -> TrainedPolicy {
        self.algorithm.policy()
    }

    /// Environment steps of the whole run: whole iterations.
    pub fn total_steps(&self) -> u64 {
        self.total_iterations() * self.algorithm.steps_per_iteration()
    }

    /// Environment steps taken.
    pub fn steps(&self) -> u64 {
        self.algorithm.iteration() * self.algorithm.steps_per_iteration()
    }

    /// Iterations done.
    pub fn iteration(&self) -> u64 {
        self.algorithm.iteration()
    }

    /// Iterations of the whole run.
    pub fn total_iterations(&self) -> u64 {
        self.config.total_steps.div_ceil(self.algorithm.steps_per_iteration())
    }
}

/// All settings with their values, those of a section after its name and a point.
fn settings_of(config: &TrainConfig) -> Result<Vec<(String, toml::Value)>> {
    let settings = toml::Table::try_from(config)?.into_iter().flat_map(|(key, value)| match value {
        toml::Value::Table(section) => {
            section.into_iter().map(|(name, value)| (format!("{key}.{name}"), value)).collect()
        }
        value => vec![(key, value)],
    });
    Ok(settings.collect())
}

/// The settings a checkpoint was made with.
pub fn config_of(checkpoint: &Checkpoint) -> Result<TrainConfig> {
    toml::from_str(&checkpoint.config).context("the settings in the checkpoint are of another version of this program")
}

/// Trains a policy; the checkpoint, `metrics.jsonl` and the TensorBoard files go to the folder `out`.
///
/// `fingerprint` says in the caller's words what is trained for (robot, task, difficulty); a checkpoint of another is refused. With
/// `resume` the run in `out` goes on as if it had never stopped. Ctrl-C or SIGTERM ends the run with a checkpoint after the running
/// iteration; a second one ends it at once.
pub fn train(
    config: &TrainConfig,
    make: MakeEnvironment,
    fingerprint: &str,
    out: &Path,
    resume: bool,
    beside: &Beside,
    on_evaluate: Evaluate,
) -> Result<TrainSummary> {
    let began = Instant::now();
    config.validate()?;
    std::fs::create_dir_all(out).with_context(|| format!("the folder {} cannot be made", out.display()))?;
    if !resume && out.join(checkpoint::FILE).exists() {
        bail!("{} already holds a run: resume it with --resume, or choose another folder", out.display());
    }
    let mut trainer = begin(config, make, fingerprint, out, resume, beside)?;
    // Before anything is computed: a folder that cannot be written to must not cost an hour.
    trainer.checkpoint()?.write(out)?;
    let cannot_log = || format!("the metrics cannot be written to {}; the last checkpoint is whole", out.display());
    let mut metrics = Metrics::open(out, trainer.iteration(), trainer.steps()).with_context(cannot_log)?;

    let stop = Signals::new()?;
    let mut progress = Progress::new(trainer.total_steps(), trainer.steps(), beside.name);
    let mut saved = Instant::now();
    let mut evaluation = Vec::new();
    let mut interrupted = false;
    while trainer.iteration() < trainer.total_iterations() {
        let before = trainer.steps();
        let report = trainer.iterate()?;
        let steps = trainer.steps();
        let last = trainer.iteration() == trainer.total_iterations();

        let [physics, inference, update] = report.times.shares();
        let mut scalars = report.scalars.clone();
        scalars.extend([
            ("charts/SPS".into(), report.times.steps_per_second()),
            ("time/physics_share".into(), physics),
            ("time/inference_share".into(), inference),
            ("time/update_share".into(), update),
            ("time/wall_seconds".into(), began.elapsed().as_secs_f64()),
        ]);
        let due = config.evaluate_every > 0 && (last || steps / config.evaluate_every > before / config.evaluate_every);
        if due {
            evaluation = on_evaluate(&trainer.policy(), steps);
            scalars.extend(evaluation.iter().cloned());
        }
        metrics.write(trainer.iteration(), steps, &scalars).with_context(cannot_log)?;
        let shown = [
            ("success", report.get("charts/success_rate")),
            ("return", report.get("charts/episodic_return")),
            ("kl", report.get("losses/approx_kl")),
        ];
        progress.update(steps, &report.times, &shown);

        interrupted = beside.anybody(stop.raised()) && !last;
        if last || interrupted || saved.elapsed().as_secs_f64() >= config.checkpoint_seconds {
            trainer.checkpoint()?.write(out)?;
            saved = Instant::now();
        }
        if interrupted {
            progress.say(&format!("stopped after {steps} steps; {} is saved, --resume goes on", out.display()));
            break;
        }
    }
    progress.finish();
    Ok(TrainSummary {
        policy: trainer.policy(),
        steps: trainer.steps(),
        iterations: trainer.iteration(),
        interrupted,
        wall: began.elapsed(),
        evaluation,
    })
}

/// A run that begins, or goes on from the checkpoint in `out`.
fn begin(
    config: &TrainConfig,
    make: MakeEnvironment,
    fingerprint: &str,
    out: &Path,
    resume: bool,
    beside: &Beside,
) -> Result<Trainer> {
    let mut trainer = if resume {
        let checkpoint = Checkpoint::read(out)?;
        Trainer::resume(&checkpoint, config, make, fingerprint)
            .with_context(|| format!("the run in {} cannot be resumed", out.display()))?
    } else {
        Trainer::new(config, make, fingerprint)?
    };
    if let Some(ranks) = &beside.ranks {
        trainer.algorithm.join_ranks(Arc::clone(ranks))?;
    }
    Ok(trainer)
}

/// Does the share of a rank that is not the first in a run that the first one [trains](train): it writes nothing.
///
/// # Errors
///
/// As [`train`].
pub fn follow(
    config: &TrainConfig,
    make: MakeEnvironment,
    fingerprint: &str,
    out: &Path,
    resume: bool,
    beside: &Beside,
) -> Result<()> {
    config.validate()?;
    let mut trainer = begin(config, make, fingerprint, out, resume, beside)?;
    let stop = Signals::new()?;
    while trainer.iteration() < trainer.total_iterations() {
        trainer.iterate()?;
        if beside.anybody(stop.raised()) {
            break;
        }
    }
    Ok(())
}

/// Notices Ctrl-C and SIGTERM while it lives; the second one ends the process.
pub(crate) struct Signals {
    flag: Arc<AtomicBool>,
    registered: Vec<signal_hook::SigId>,
}

impl Signals {
    /// Starts to notice them.
    pub(crate) fn new() -> Result<Self> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        let flag = Arc::new(AtomicBool::new(false));
        let mut registered = Vec::new();
        for signal in [SIGINT, SIGTERM] {
            // In this order: the first signal raises the flag, the next one finds it raised and ends the process.
            registered.push(
                signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&flag))
                    .context("no handler for Ctrl-C can be set up")?,
            );
            registered.push(
                signal_hook::flag::register(signal, Arc::clone(&flag))
                    .context("no handler for Ctrl-C can be set up")?,
            );
        }
        Ok(Self { flag, registered })
    }

    /// Whether there was one.
    pub(crate) fn raised(&self) -> bool {
        self.flag.load(Ordering::Relaxed)
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        for id in self.registered.drain(..) {
            signal_hook::low_level::unregister(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::{Environment, Told, Trivial, View};
    use crate::methods::Method;
    use crate::methods::baselines::{MappoConfig, MatConfig};
    use crate::methods::imagination::ImaginationConfig;
    use crate::policy::Memories;
    use crate::robot::Robot;
    use composer_shared::policy::Task;

    fn small(method: Method) -> TrainConfig {
        TrainConfig {
            method,
            environments: 4,
            rollout_steps: 24,
            minibatches: 2,
            epochs: 2,
            critic_epochs: 2,
            ..Default::default()
        }
    }

    /// Teams of different sizes, one with a dead module.
    fn teams(index: usize) -> Result<Box<dyn Environment>> {
        let team = Trivial::new(3 + index % 3, Told::Head);
        Ok(Box::new(if index == 2 { team.with_dead(1) } else { team }))
    }

    #[test]
    fn six_iterations_are_three_and_a_resumption_and_three() {
        for (method, told) in
            Method::COMPOSERS.map(|method| (method, false)).into_iter().chain([(Method::Composer, true)])
        {
            // With a learning rate that falls and with one that is adapted.
            let kl_target = if method.imagination() { 0.01 } else { 0.0 };
            let imagination = ImaginationConfig { told, ..Default::default() };
            let config = TrainConfig { total_steps: 6 * 96, kl_target, imagination, ..small(method) };
            let mut straight = Trainer::new(&config, &teams, "trivial").unwrap();
            let reports: Vec<_> = (0..6).map(|_| straight.iterate().unwrap().scalars).collect();

            let folder = tempfile::tempdir().unwrap();
            let mut first = Trainer::new(&TrainConfig { threads: 1, ..config.clone() }, &teams, "trivial").unwrap();
            for expected in &reports[..3] {
                // NaN is not equal to itself; the text is.
                assert_eq!(format!("{:?}", first.iterate().unwrap().scalars), format!("{expected:?}"));
            }
            first.checkpoint().unwrap().write(folder.path()).unwrap();
            drop(first);
            let checkpoint = Checkpoint::read(folder.path()).unwrap();
            assert!(checkpoint.state.episodes.iter().any(|episode| !episode.actions.is_empty()));
            let mut second = Trainer::resume(&checkpoint, &config, &teams, "trivial").unwrap();
            for expected in &reports[3..] {
                assert_eq!(format!("{:?}", second.iterate().unwrap().scalars), format!("{expected:?}"));
            }
            assert_eq!(second.checkpoint().unwrap(), straight.checkpoint().unwrap());
            assert_eq!(second.policy(), straight.policy());
        }
    }

    #[test]
    fn a_curriculum_a_second_stage_and_what_modules_remember_go_on_bit_for_bit_whatever_the_threads() {
        use crate::env::{EnvConfig, FaultTraining, SnakeEnv};
        use crate::methods::curriculum::{CurriculumConfig, SecondStage};
        let make: MakeEnvironment = &|index| {
            let mut env = EnvConfig::new(Task::GoalReaching, Robot::default().with_modules(6 + index % 3)?);
            env.faults = FaultTraining { probability: 0.9, most: 3, mixed: true, latest: 0.3, ..env.faults };
            env.vary = crate::vary::Variation::from_toml("mass = [0.5, 2.0]").unwrap();
            // Short, so that many episodes end.
            env.task.settings.cap = 7;
            Ok(Box::new(SnakeEnv::new(Arc::new(env))))
        };
        let config = TrainConfig {
            total_steps: 6 * 96,
            curriculum: CurriculumConfig { ramp_steps: 200, failure_share: 0.5, varied: 0.6, ..Default::default() },
            second: SecondStage { from: 4 * 96, learning_rate: 1e-3, faults: 1.1, varied: 0.9 },
            inputs: composer_shared::observation::SIZE,
            memory: composer_shared::policy::MEMORY,
            distance_bias: true,
            ..small(Method::ComposerNoImagination)
        };
        let mut straight = Trainer::new(&TrainConfig { threads: 2, ..config.clone() }, make, "snake").unwrap();
        let reports: Vec<_> = (0..6).map(|_| straight.iterate().unwrap()).collect();
        let of = |name: &str| reports.iter().map(|report| report.get(name) as f32).collect::<Vec<_>>();
        assert_eq!(of("curriculum/faults"), [96.0 / 200.0, 192.0 / 200.0, 1.0, 1.1, 1.1, 1.1]);
        let rates = of("charts/learning_rate");
        assert!((rates[3] - 5e-4 * (1.0 - 0.75 * 0.9)).abs() < 1e-9 && rates[4..] == [1e-3, 1e-3], "{rates:?}");
        for cut in [2, 5] {
            let mut first = Trainer::new(&TrainConfig { threads: 1, ..config.clone() }, make, "snake").unwrap();
            (0..cut).for_each(|_| drop(first.iterate().unwrap()));
            let folder = tempfile::tempdir().unwrap();
            first.checkpoint().unwrap().write(folder.path()).unwrap();
            let checkpoint = Checkpoint::read(folder.path()).unwrap();
            // In the middle of episodes, so that there is something to remember.
            assert!(checkpoint.state.episodes.iter().any(|episode| !episode.actions.is_empty()));
            let mut second = Trainer::resume(&checkpoint, &config, make, "snake").unwrap();
            (cut..6).for_each(|_| drop(second.iterate().unwrap()));
            assert_eq!(second.checkpoint().unwrap().state, straight.checkpoint().unwrap().state, "cut at {cut}");
        }
    }

    #[test]
    fn ranks_come_to_the_checkpoint_of_one_process_bit_for_bit_and_go_on_from_it_in_another_number() {
        // Chunks of 64 samples: two in each minibatch.
        let config = |method| TrainConfig { rollout_steps: 48, total_steps: 4 * 192, threads: 1, ..small(method) };
        for config in [config(Method::Composer), TrainConfig { method: Method::Mat, ..small_baseline(Method::Mat) }] {
            // What MAT has too few environments for, a rank that has none must do, too.
            let mut alone = Trainer::new(&config, &same_teams, "trivial").unwrap();
            let reports: Vec<_> = (0..4).map(|_| format!("{:?}", alone.iterate().unwrap().scalars)).collect();
            let run = |count: usize, from: Option<&Checkpoint>, iterations: usize| -> Checkpoint {
                let work = |ranks: Arc<dyn Ranks>| {
                    let begun = from.map(|from| Trainer::resume(from, &config, &same_teams, "trivial"));
                    let mut trainer = begun.unwrap_or_else(|| Trainer::new(&config, &same_teams, "trivial")).unwrap();
                    trainer.algorithm.join_ranks(ranks).unwrap();
                    for expected in &reports[trainer.iteration() as usize..][..iterations] {
                        assert_eq!(format!("{:?}", trainer.iterate().unwrap().scalars), *expected);
                    }
                    trainer.checkpoint().unwrap()
                };
                let ranks = crate::methods::ranks::tests::in_this_process(count);
                let ends: Vec<Checkpoint> = std::thread::scope(|scope| {
                    let begin = |ranks| scope.spawn(|| work(Arc::new(ranks)));
                    let all: Vec<_> = ranks.into_iter().map(begin).collect();
                    all.into_iter().map(|rank| rank.join().unwrap()).collect()
                });
                assert!(ends.iter().all(|end| *end == ends[0]));
                ends[0].clone()
            };
            let half = run(2, None, 2);
            assert_eq!(run(3, Some(&half), 2), alone.checkpoint().unwrap());
        }
        let smp = small_baseline(Method::Smp);
        let mut smp = Trainer::new(&smp, &same_teams, "trivial").unwrap();
        let [ranks] = crate::methods::ranks::tests::in_this_process(1).try_into().unwrap();
        assert!(
            smp.algorithm.join_ranks(Arc::new(ranks)).unwrap_err().to_string().contains("smp learns in one process")
        );
    }

    /// Teams of three that do not differ.
    fn same_teams(_index: usize) -> Result<Box<dyn Environment>> {
        Ok(Box::new(Trivial::new(3, Told::Head)))
    }

    /// Settings with which every baseline is quick.
    fn small_baseline(method: Method) -> TrainConfig {
        let mut config = TrainConfig { method, total_steps: 6 * 96, ..TrainConfig::default() };
        config.ppo.environments = 4;
        config.ppo.rollout_steps = 24;
        config.ppo.minibatches = 2;
        config.ppo.epochs = 2;
        config.mappo = MappoConfig { environments: 4, rollout_steps: 24, epochs: 2, ..MappoConfig::default() };
        config.mat =
            MatConfig { environments: 4, rollout_steps: 24, minibatches: 2, epochs: 2, ..MatConfig::default() };
        config.mat_dec.environments = 4;
        config.mat_dec.rollout_steps = 24;
        config.mat_dec.minibatches = 2;
        config.mat_dec.epochs = 2;
        config.smp.rollout_steps = 24;
        config.smp.random_steps = 100;
        config.smp.updates_per_step = 0.0313;
        config.smp.widths = [24, 16];
        config
    }

    const BASELINES: [Method; 5] = [Method::Ppo, Method::Mappo, Method::Mat, Method::MatDec, Method::Smp];

    #[test]
    fn baselines_go_on_bit_for_bit_too_whatever_the_threads() {
        let teams: MakeEnvironment = &|index| {
            let team = Trivial::new(3, Told::Head);
            Ok(Box::new(if index == 2 { team.with_dead(1) } else { team }))
        };
        for method in BASELINES {
            let config = small_baseline(method);
            let mut straight = Trainer::new(&TrainConfig { threads: 2, ..config.clone() }, teams, "trivial").unwrap();
            let report = straight.iterate().unwrap();
            if method != Method::Smp {
                // Acting and scoring agree: before anything is learnt the ratio is 1, with a dead module too.
                let kl = report.get("losses/first_minibatch_kl");
                assert!(kl.abs() < 1e-6, "{method}: {kl}");
                let sigma = if method == Method::Ppo { 1.0 } else { 0.3655 };
                assert!((report.get("charts/sigma") - sigma).abs() < 0.01, "{method}");
            }
            (0..3).for_each(|_| drop(straight.iterate().unwrap()));
            let mut first = Trainer::new(&TrainConfig { threads: 1, ..config.clone() }, teams, "trivial").unwrap();
            (0..2).for_each(|_| drop(first.iterate().unwrap()));
            let folder = tempfile::tempdir().unwrap();
            first.checkpoint().unwrap().write(folder.path()).unwrap();
            let checkpoint = Checkpoint::read(folder.path()).unwrap();
            let mut second = Trainer::resume(&checkpoint, &config, teams, "trivial").unwrap();
            (0..2).for_each(|_| drop(second.iterate().unwrap()));
            assert_eq!(second.checkpoint().unwrap().state, straight.checkpoint().unwrap().state, "{method}");
            // The policy survives its file and acts, for longer snakes too.
            let policy = second.policy();
            let text = serde_json::to_string(&policy).unwrap();
            let read: TrainedPolicy = serde_json::from_str(&text).unwrap();
            assert_eq!(read, policy);
            read.check().unwrap();
            for modules in [3, 5, 12] {
                let mut view = View::default();
                let mut team = Trivial::new(modules, Told::All);
                team.reset(1);
                team.view(&mut view);
                let mut actions = Vec::new();
                read.policy().act(&view, 0, &mut Memories::default(), &mut actions, None);
                assert_eq!(actions.len(), modules);
                assert!(actions.as_flattened().iter().all(|a| a.is_finite()), "{method}");
            }
            // And says why it cannot be frozen, if it cannot.
            let alone = matches!(method, Method::Mappo | Method::MatDec);
            assert_eq!(policy.runs_on_modules().is_ok(), alone);
            let error = policy.network().unwrap_err().to_string();
            assert!(error.starts_with(method.name()) || alone, "{error}");
            assert!(!error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn baselines_that_need_one_length_refuse_several() {
        for method in [Method::Mappo, Method::Smp] {
            let error = Trainer::new(&small_baseline(method), &teams, "trivial").err().unwrap().to_string();
            assert!(error.contains("snakes of one length") && error.contains("lengths = []"), "{error}");
        }
        let long: MakeEnvironment = &|_| Ok(Box::new(Trivial::new(12, Told::All)));
        let error = Trainer::new(&small_baseline(Method::Ppo), long, "trivial").err().unwrap().to_string();
        assert!(error.contains("ppo is made for at most 11 modules"), "{error}");
        let mut config = small_baseline(Method::Mat);
        config.mat.epochs = 0;
        let error = Trainer::new(&config, &teams, "trivial").err().unwrap().to_string();
        assert_eq!(error, "mat.epochs is 0; it must be from 1 to 1000");
    }

    #[test]
    fn a_whole_run_can_be_stopped_and_resumed_through_its_folder() {
        let make: MakeEnvironment = &teams;
        let quiet = |_: &TrainedPolicy, steps: u64| vec![("eval/steps".to_string(), steps as f64)];
        let config = TrainConfig { total_steps: 4 * 96, evaluate_every: 200, ..small(Method::ComposerNeither) };
        let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let whole = train(&config, make, "trivial", a.path(), false, &Beside::default(), &mut { quiet }).unwrap();
        assert_eq!((whole.steps, whole.iterations, whole.interrupted), (384, 4, false));
        assert_eq!(whole.evaluation, [("eval/steps".to_string(), 384.0)]);

        // The learning rate depends on the length of the run, so the half run must know the whole length: stop it by hand.
        let mut half = Trainer::new(&config, make, "trivial").unwrap();
        half.iterate().unwrap();
        half.iterate().unwrap();
        half.checkpoint().unwrap().write(b.path()).unwrap();
        let resumed = train(&config, make, "trivial", b.path(), true, &Beside::default(), &mut { quiet }).unwrap();
        assert_eq!(resumed.policy, whole.policy);
        assert_eq!(Checkpoint::read(a.path()).unwrap(), Checkpoint::read(b.path()).unwrap());
        let lines = std::fs::read_to_string(b.path().join(metrics::FILE)).unwrap();
        assert_eq!(lines.lines().count(), 2, "{lines}");
        assert!(lines.contains("losses/approx_kl"), "{lines}");
    }

    #[test]
    fn the_settings_are_in_the_checkpoint() {
        let config = small(Method::ComposerNeither);
        let checkpoint = Trainer::new(&config, &teams, "trivial").unwrap().checkpoint().unwrap();
        assert_eq!(config_of(&checkpoint).unwrap(), config);
    }

    #[test]
    fn what_cannot_be_resumed_is_refused_with_a_reason() {
        let config = small(Method::ComposerNeither);
        let checkpoint = Trainer::new(&config, &teams, "trivial").unwrap().checkpoint().unwrap();
        let refused = |config: &TrainConfig, fingerprint: &str| {
            Trainer::resume(&checkpoint, config, &teams, fingerprint).err().unwrap().to_string()
        };
        assert!(refused(&config, "snake").contains("another robot or task"));
        let changed = TrainConfig { gamma: 0.5, total_steps: 7, ..config.clone() };
        let error = refused(&changed, "trivial");
        assert!(error.contains("gamma (it was 0.97)") && !error.contains("total_steps"), "{error}");
        let imagination = ImaginationConfig { follow: 3.0, ..config.imagination.clone() };
        let error = refused(&TrainConfig { imagination, ..config.clone() }, "trivial");
        assert!(error.contains("imagination.follow (it was 0.1)") && !error.contains("bound"), "{error}");
        let mut without = checkpoint.clone();
        without.state.learners.clear();
        let error = Trainer::resume(&without, &config, &teams, "trivial").err().unwrap().to_string();
        assert!(error.contains("0 policies where the method composer-neither has 1"), "{error}");
        let longer = TrainConfig { total_steps: 2_000_000, threads: 3, ..config.clone() };
        assert!(Trainer::resume(&checkpoint, &longer, &teams, "trivial").is_ok());

        let folder = tempfile::tempdir().unwrap();
        let run = |resume| {
            train(&config, &teams, "trivial", folder.path(), resume, &Beside::default(), &mut |_, _| Vec::new())
                .err()
                .unwrap()
                .to_string()
        };
        assert!(run(true).contains("holds no checkpoint"));
        checkpoint.write(folder.path()).unwrap();
        assert!(run(false).contains("already holds a run"));
    }

    #[test]
    fn an_adapted_learning_rate_grows_while_the_policy_hardly_moves() {
        let config = TrainConfig { kl_target: 1.0, kl_stop: 10.0, ..small(Method::Composer) };
        let mut trainer = Trainer::new(&config, &teams, "trivial").unwrap();
        let rates = [0, 1, 2].map(|_| trainer.iterate().unwrap());
        for (report, expected) in rates.iter().zip([5e-4, 7.5e-4, 1.125e-3]) {
            for name in ["charts/learning_rate", "imagination/learning_rate"] {
                assert!((report.get(name) - expected).abs() < 1e-8, "{name}: {}", report.get(name));
            }
        }
    }

    /// Mean reward of a policy without noise on episodes it was not trained on.
    fn reward(policy: &TrainedPolicy, modules: usize, told: Told) -> f32 {
        let mut team = Trivial::new(modules, told);
        let mut view = View::default();
        let (decides, mut actions) = (policy.policy(), Vec::new());
        let total: f32 = (0..200)
            .map(|seed| {
                team.reset(seed);
                team.view(&mut view);
                decides.act(&view, 0, &mut Memories::default(), &mut actions, None);
                team.step(&actions).reward
            })
            .sum();
        total / 200.0
    }

    fn trained(method: Method, total_steps: u64, make: MakeEnvironment) -> Trainer {
        let config = TrainConfig {
            method,
            total_steps,
            environments: 16,
            rollout_steps: 20,
            learning_rate: 1e-3,
            gamma: 0.0,
            imagination: ImaginationConfig { follow: 1.0, ..Default::default() },
            ..Default::default()
        };
        let mut trainer = Trainer::new(&config, make, "trivial").unwrap();
        while trainer.iteration() < trainer.total_iterations() {
            trainer.iterate().unwrap();
        }
        trainer
    }

    fn learn(method: Method, told: Told) -> TrainedPolicy {
        trained(method, 30_000, &|_| Ok(Box::new(Trivial::new(4, told)))).policy()
    }

    #[test]
    fn all_methods_solve_the_trivial_task() {
        for method in Method::COMPOSERS {
            let policy = learn(method, Told::All);
            let reward = reward(&policy, 4, Told::All);
            assert!(reward > 0.95, "{method}: {reward}");
        }
    }

    #[test]
    fn only_attention_carries_the_target_from_the_head() {
        let reward_of = |method| reward(&learn(method, Told::Head), 4, Told::Head);
        let attention = reward_of(Method::ComposerNoImagination);
        assert!(attention > 0.95, "{attention}");
        // Three of four modules can do no better than zero: 1 - 3/4 * 1/3.
        let alone = reward_of(Method::ComposerNeither);
        assert!(alone < 0.8, "{alone}");
    }
}
