//! A map of what each broken module costs, and each pair of them: what to look at before a robot is trusted. With [`Specialists`] also what the body could
//! still do: for every fault of one module that is not mastered a policy is trained that knows it, because it never sees anything else.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use composer_shared::CRC_32;
use composer_shared::policy::Task;
use composer_sim_bridge::faults::{FaultKind, FaultPlan, PlannedFault, Target};
use serde::{Deserialize, Serialize};

use crate::eval::parallel;
use crate::files::{create_folder, read_published, with_new, write_whole};
use crate::plot::{Heatmap, MapWords, heatmaps};
use crate::policy_source::{PolicySource, shipped_seed};
use crate::release::measured::{Measured, measured, published_episodes};
use crate::rows::Rows;
use crate::run::RunConfig;
use crate::run_folder::{load_config, load_run, trained};
use crate::side_by_side::side_by_side;
use crate::sim::PHYSICS;
use crate::tasks::task_name;

/// What can be broken about a module, from the start of the episode on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
enum Kind {
    #[serde(rename = "unplugged")]
    Unplugged,
    #[serde(rename = "motors dead")]
    MotorsDead,
    #[serde(rename = "sensors blind")]
    SensorsBlind,
}

impl Kind {
    const ALL: [Kind; 3] = [Kind::Unplugged, Kind::MotorsDead, Kind::SensorsBlind];

    fn words(self) -> &'static str {
        match self {
            Kind::Unplugged => "unplugged",
            Kind::MotorsDead => "motors dead",
            Kind::SensorsBlind => "sensors blind",
        }
    }

    fn fault(self, module: usize) -> FaultKind {
        match self {
            Kind::Unplugged => FaultKind::Unplug(Target::Module(module)),
            Kind::MotorsDead => FaultKind::Action(Target::Module(module)),
            Kind::SensorsBlind => FaultKind::Observation(Target::Module(module)),
        }
    }
}

/// A cell of a map: two modules, or the same one twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Cell {
    kind: Kind,
    modules: [usize; 2],
}

impl Cell {
    /// Whether only one module is broken.
    fn alone(&self) -> bool {
        self.modules[0] == self.modules[1]
    }

    /// Its faults, which hold from the start on.
    fn plan(&self) -> FaultPlan {
        let broken = |module| PlannedFault { kind: self.kind.fault(module), at_ns: Some(0), until_ns: None };
        let faults = if self.alone() { &self.modules[..1] } else { &self.modules };
        FaultPlan { faults: faults.iter().map(|module| broken(*module)).collect() }
    }
}

/// All cells of a robot of so many modules: for each kind the upper triangle, row by row.
fn cells(modules: usize) -> Vec<Cell> {
    let pairs = move |kind| (0..modules).flat_map(move |a| (a..modules).map(move |b| Cell { kind, modules: [a, b] }));
    Kind::ALL.into_iter().flat_map(pairs).collect()
}

/// What is published of a cell: an element of the data, and what figures and table are made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Mapped {
    #[serde(rename = "policy", with = "task_name")]
    task: Task,
    #[serde(flatten)]
    cell: Cell,
    measured: Measured,
    /// What a policy can do that knows the fault, if one was trained.
    specialist: Option<Bound>,
}

/// What a specialist can do.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Bound {
    /// Environment steps of its training.
    environment_steps: u64,
    /// Whether it began with the policy that ships, or with nothing.
    from_policy: bool,
    measured: Measured,
}

/// Maps to be made, and where.
#[derive(Clone, Debug)]
pub struct FaultMaps {
    /// Tasks.
    pub tasks: Vec<Task>,
    /// Episodes of each module by itself, the first of the published ones.
    pub episodes: u64,
    /// Episodes of each pair of modules.
    pub pair_episodes: u64,
    /// What to train and compare with, if anything.
    pub specialists: Option<Specialists>,
    /// Threads of the measuring.
    pub threads: usize,
    /// Folder of the cells that are done, and of the specialists' runs.
    pub runs: PathBuf,
    /// Folder for figures, table and data.
    pub out: PathBuf,
}

/// A policy for each fault of one module that is not mastered.
#[derive(Clone, Debug)]
pub struct Specialists {
    /// Success from which on a fault is mastered.
    pub mastered: f64,
    /// Environment steps of each.
    pub steps: u64,
    /// Folder of the settings, `TASK.toml`, which the learner's are taken from.
    pub configs: PathBuf,
    /// Folder of finished runs, `TASK-SEED`: each begins with the policy that ships of its task. None: from nothing.
    pub start: Option<PathBuf>,
    /// Settings that differ from those of the files, `key=value`.
    pub settings: Vec<String>,
    /// Runs side by side, each on its share of the cores; none: the cores.
    pub jobs: Option<u64>,
}

/// What is published, in the folder for it.
const DATA_FILE: &str = "map.json";

impl FaultMaps {
    /// Measures, trains and publishes what is not done yet; the table. Of tasks that were not asked for what was published before stays. None:
    /// interrupted, the same call goes on.
    pub fn publish(&self) -> Result<Option<String>> {
        // Read first: what cannot be read is said before it takes hours.
        let mut data: Vec<Mapped> = read_published(&self.out.join(DATA_FILE), |_| true)?;
        create_folder(&self.runs)?;
        create_folder(&self.out)?;
        let kept = Rows::open(&self.runs.join("rows.json"))?;
        for &task in &self.tasks {
            let mut new = self.map(task, &kept)?;
            if let Some(specialists) = &self.specialists
                && !specialists.compare(task, &mut new, &kept, self)?
            {
                return Ok(None);
            }
            self.draw(task, &new)?;
            data = with_new(data, new, |one| one.task, |one| (one.task as u8, one.cell.kind, one.cell.modules));
        }
        let table = table(&data)?;
        write_whole(&self.out.join(DATA_FILE), serde_json::to_string_pretty(&data)?.as_bytes())?;
        write_whole(&self.out.join("table.md"), table.as_bytes())?;
        Ok(Some(table))
    }

    /// Measures the policy that ships in every cell.
    fn map(&self, task: Task, kept: &Rows) -> Result<Vec<Mapped>> {
        let source = PolicySource::load(task.name())?;
        let config = source.environment(None, None)?;
        if config.robot.modules < 2 {
            bail!("a map of pairs needs a robot with two modules or more");
        }
        let cells = cells(config.robot.modules);
        // A cell is small: one thread each.
        let found = parallel(cells.len(), self.threads, |number| {
            if number % 12 == 0 {
                eprintln!("{task}: {number} of {}", cells.len());
            }
            let plan = cells[number].plan();
            let episodes = if cells[number].alone() { self.episodes } else { self.pair_episodes };
            measured(kept, &source, &config, &plan, &plan, (episodes, 1))
        });
        let found = found.into_iter().collect::<Result<Vec<_>>>()?;
        let mapped = |(cell, measured)| Mapped { task, cell, measured, specialist: None };
        Ok(cells.into_iter().zip(found).map(mapped).collect())
    }

    /// The figures of a task.
    fn draw(&self, task: Task, data: &[Mapped]) -> Result<()> {
        let figure = |name: &str, what: &str, maps: Vec<Heatmap>| {
            let words = MapWords {
                title: format!("{}: {what}", task.title()),
                columns: "module".into(),
                rows: "and module".into(),
                largest: Some(1.0),
            };
            write_whole(&self.out.join(name), heatmaps(&maps, &words).as_bytes())
        };
        figure(&format!("{task}.svg"), "success with broken modules", success_maps(data))?;
        if self.specialists.is_some() {
            figure(
                &format!("{task}-specialists.svg"),
                "of what a specialist can (grey: none trained)",
                compared(data),
            )?;
        }
        Ok(())
    }
}

/// A specialist to be trained.
struct Specialist {
    /// Which cell it is for.
    number: usize,
    folder: PathBuf,
    config: RunConfig,
    plan: FaultPlan,
}

impl Specialists {
    /// Trains and measures one for every cell of one module that is not mastered. False: interrupted.
    fn compare(&self, task: Task, data: &mut [Mapped], kept: &Rows, maps: &FaultMaps) -> Result<bool> {
        let mut all = Vec::new();
        for (number, mapped) in data.iter().enumerate() {
            if !mapped.cell.alone() || mapped.measured.success_rate >= self.mastered {
                continue;
            }
            let Cell { kind, modules } = mapped.cell;
            let name = format!("{task}-{}-{}", kind.words().replace(' ', "-"), modules[0]);
            let plan = mapped.cell.plan();
            let config = self.settings(task, &plan)?;
            all.push(Specialist { number, folder: maps.runs.join("specialists").join(name), config, plan });
        }
        let measured = |one: &Specialist, threads: usize| -> Result<Measured> {
            let digest = CRC_32.checksum(toml::to_string(&one.config)?.as_bytes());
            let key =
                format!("{task} specialist {digest:08x} {} episodes={} physics={PHYSICS}", one.plan, maps.episodes);
            kept.get(&key, || {
                let (config, policy) = load_run(&one.folder)?;
                let size = (maps.episodes, threads);
                Ok(published_episodes(config.evaluation(), &*policy.policy(), &one.plan, size))
            })
        };
        let folders: Vec<&Path> = all.iter().map(|one| &*one.folder).collect();
        let finished = side_by_side(&folders, self.jobs, |number, threads| {
            let one = &all[number];
            match trained(&one.folder, &one.config, threads)? {
                true => measured(one, threads).map(drop),
                false => Ok(()),
            }
        })?;
        if !finished {
            return Ok(false);
        }
        for one in &all {
            data[one.number].specialist = Some(Bound {
                environment_steps: self.steps,
                from_policy: self.start.is_some(),
                measured: measured(one, 1)?,
            });
        }
        Ok(true)
    }

    /// The settings of a specialist: the learner's of the policy that ships on the robot's own length, with this fault in every episode and nothing else
    /// broken or varied.
    fn settings(&self, task: Task, plan: &FaultPlan) -> Result<RunConfig> {
        let mut config = load_config(&self.configs.join(format!("{task}.toml")))?.plain();
        if config.task.name != task {
            bail!("{} has settings for {}, not for {task}", self.configs.display(), config.task.name);
        }
        config.faults.fixed = plan.to_string();
        config.train.total_steps = self.steps;
        config.train.evaluate_every = 0;
        if let Some(folder) = &self.start {
            config.train.start = folder.join(format!("{task}-{}", shipped_seed(task.name())?)).display().to_string();
        }
        for setting in &self.settings {
            config.set(setting)?;
        }
        config.validate()?;
        Ok(config)
    }
}

/// An empty map of each kind.
fn empty(data: &[Mapped]) -> Vec<Heatmap> {
    let modules = modules(data);
    let map = |kind: Kind| Heatmap { title: kind.words().into(), modules, weights: vec![f32::NAN; modules * modules] };
    Kind::ALL.into_iter().map(map).collect()
}

/// Modules of the robot.
fn modules(data: &[Mapped]) -> usize {
    data.iter().map(|mapped| mapped.cell.modules[1] + 1).max().unwrap_or(0)
}

/// A map of each kind: single modules on the diagonal, pairs on either side of it.
fn success_maps(data: &[Mapped]) -> Vec<Heatmap> {
    let mut maps = empty(data);
    for Mapped { cell: Cell { kind, modules: [a, b] }, measured, .. } in data {
        let map = &mut maps[*kind as usize];
        for index in [a * map.modules + b, b * map.modules + a] {
            map.weights[index] = measured.success_rate as f32;
        }
    }
    maps
}

/// On the diagonal the share of a specialist's success that the one policy has, where there is one.
fn compared(data: &[Mapped]) -> Vec<Heatmap> {
    let mut maps = empty(data);
    for mapped in data.iter().filter(|mapped| mapped.cell.alone()) {
        let Some(bound) = &mapped.specialist else { continue };
        let share = mapped.measured.success_rate / bound.measured.success_rate.max(1e-9);
        let map = &mut maps[mapped.cell.kind as usize];
        map.weights[mapped.cell.modules[0] * (map.modules + 1)] = share.min(1.0) as f32;
    }
    maps
}

/// Success by module, the mean and the worst of the pairs; what was measured how.
fn table(data: &[Mapped]) -> Result<String> {
    let longest = modules(data);
    let mut table = String::from("| task | broken |");
    (0..longest).for_each(|module| table += &format!(" {module} |"));
    writeln!(table, " pairs, mean | worst pair |\n|{}", "---|".repeat(longest + 4))?;
    for task in Task::ALL {
        for kind in Kind::ALL {
            let of_kind = || data.iter().filter(|mapped| mapped.task == task && mapped.cell.kind == kind);
            if of_kind().next().is_none() {
                continue;
            }
            let mut single: Vec<String> = of_kind().filter(|mapped| mapped.cell.alone()).map(success).collect();
            single.resize(longest, "-".into());
            let pairs: Vec<&Mapped> = of_kind().filter(|mapped| !mapped.cell.alone()).collect();
            let mean = pairs.iter().map(|pair| pair.measured.success_rate).sum::<f64>() / pairs.len() as f64;
            let worst = pairs.iter().min_by(|a, b| a.measured.success_rate.total_cmp(&b.measured.success_rate));
            let worst = worst.map_or(String::new(), |pair| {
                format!("{:.2} ({} and {})", pair.measured.success_rate, pair.cell.modules[0], pair.cell.modules[1])
            });
            let (task, words) = (task.title(), kind.words());
            writeln!(table, "| {task} | {words} | {} | {mean:.2} | {worst} |", single.join(" | "))?;
        }
    }
    let episodes = |alone: bool| {
        let of = data.iter().filter(|mapped| mapped.cell.alone() == alone);
        counted(of.map(|mapped| mapped.measured.episodes.to_string()))
    };
    write!(
        table,
        "\nSuccess with module 0 (head) to the last broken from the start of the episode on, {} published episodes each; of pairs {}.",
        episodes(true),
        episodes(false)
    )?;
    let bounds = data.iter().filter_map(|mapped| mapped.specialist.as_ref());
    let trained = counted(bounds.map(|bound| {
        let start = if bound.from_policy { "from the one policy on" } else { "from nothing" };
        format!("for {} environment steps {start}", bound.environment_steps)
    }));
    if !trained.is_empty() {
        write!(
            table,
            " Behind \"of\" the success of a specialist: a float policy trained {trained} with that fault alone."
        )?;
    }
    table.push('\n');
    Ok(table)
}

/// Success in a cell, and what a specialist has.
fn success(mapped: &Mapped) -> String {
    let success = mapped.measured.success_rate;
    match &mapped.specialist {
        Some(bound) => format!("{success:.2} of {:.2}", bound.measured.success_rate),
        None => format!("{success:.2}"),
    }
}

/// Everything that occurs, the most frequent first.
fn counted(words: impl Iterator<Item = String>) -> String {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    words.for_each(|word| *counts.entry(word).or_default() += 1);
    let mut words: Vec<(String, usize)> = counts.into_iter().collect();
    words.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    words.into_iter().map(|(word, _)| word).collect::<Vec<_>>().join(" or ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_sim_bridge::faults::Fault;

    fn published(file: &Path) -> Result<Vec<Mapped>> {
        read_published(file, |_| true)
    }

    fn mapped(kind: Kind, modules: [usize; 2], success_rate: f64) -> Mapped {
        let measured = Measured { success_rate, episodes: 2, ..Measured::default() };
        Mapped { task: Task::GoalReaching, cell: Cell { kind, modules }, measured, specialist: None }
    }

    /// The whole of it, with a training of two iterations for each fault that is not mastered; a second call finds everything done.
    #[test]
    fn a_specialist_is_trained_for_what_is_not_mastered_and_only_once() {
        let folder = tempfile::tempdir().unwrap();
        let set = ["environments=4", "rollout_steps=32", "minibatches=2", "epochs=1", "critic_epochs=1"];
        let specialists = Specialists {
            mastered: 0.9,
            steps: 256,
            configs: concat!(env!("CARGO_MANIFEST_DIR"), "/configs").into(),
            start: None,
            settings: set.map(String::from).into(),
            jobs: None,
        };
        let maps = FaultMaps {
            tasks: vec![Task::GoalReaching],
            episodes: 2,
            pair_episodes: 1,
            specialists: Some(specialists.clone()),
            threads: 1,
            runs: folder.path().into(),
            out: folder.path().into(),
        };
        let kept = Rows::open(&folder.path().join("rows.json")).unwrap();
        // Of the first two modules' dead motors the first is not mastered; pairs have no specialist.
        let kind = Kind::MotorsDead;
        let before = [([0, 0], 0.5), ([0, 1], 0.5), ([1, 1], 0.95)].map(|(m, success)| mapped(kind, m, success));
        let compare = |specialists: &Specialists| {
            let mut data = before.clone();
            assert!(specialists.compare(Task::GoalReaching, &mut data, &kept, &maps).unwrap());
            data
        };
        let data = compare(&specialists);
        assert_eq!(data.iter().map(|mapped| mapped.specialist.is_some()).collect::<Vec<_>>(), [true, false, false]);
        let bound = data[0].specialist.as_ref().unwrap();
        assert_eq!((bound.environment_steps, bound.from_policy, bound.measured.episodes), (256, false, 2));
        let run = folder.path().join("specialists/goal-reaching-motors-dead-0");
        let config = load_config(&run.join("config.toml")).unwrap();
        assert_eq!((config.faults.fixed.as_str(), config.faults.probability), ("action:#0@0s", 0.0));
        let metrics = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
        assert_eq!(metrics.lines().count(), 2);
        assert_eq!(compare(&specialists), data);
        assert_eq!(std::fs::read_to_string(run.join("metrics.jsonl")).unwrap(), metrics);
        assert_eq!(compare(&Specialists { mastered: 0.1, ..specialists.clone() }), before);
        // From the run of the seed that ships, and from no other.
        let start = Specialists { start: Some("somewhere".into()), ..specialists };
        let settings = start.settings(Task::GoalReaching, &before[0].cell.plan()).unwrap();
        let seed = shipped_seed("goal-reaching").unwrap();
        assert_eq!(settings.train.start, format!("somewhere/goal-reaching-{seed}"));
    }

    /// Also of what was published before.
    #[test]
    fn a_task_that_is_asked_for_twice_is_published_once() {
        let folder = tempfile::tempdir().unwrap();
        let maps = FaultMaps {
            tasks: vec![Task::ShapeFormation; 2],
            episodes: 1,
            pair_episodes: 1,
            specialists: None,
            threads: 2,
            runs: folder.path().into(),
            out: folder.path().into(),
        };
        let file = folder.path().join(DATA_FILE);
        std::fs::write(&file, serde_json::to_string(&[mapped(Kind::MotorsDead, [0, 0], 0.5)]).unwrap()).unwrap();
        maps.publish().unwrap().unwrap();
        let data = published(&file).unwrap();
        assert_eq!(data.len(), 1 + cells(8).len());
        assert_eq!(data[0].task, Task::GoalReaching);
    }

    #[test]
    fn maps_and_table_show_a_share_of_what_a_specialist_can() {
        let mut data = vec![
            mapped(Kind::MotorsDead, [0, 0], 0.6),
            mapped(Kind::MotorsDead, [0, 1], 0.25),
            mapped(Kind::MotorsDead, [1, 1], 0.95),
        ];
        let measured = Measured { success_rate: 0.8, ..Measured::default() };
        data[0].specialist = Some(Bound { environment_steps: 5000, from_policy: true, measured });
        let weights = |maps: Vec<Heatmap>| maps[Kind::MotorsDead as usize].weights.clone();
        assert_eq!(weights(success_maps(&data)), [0.6, 0.25, 0.25, 0.95]);
        let shares = weights(compared(&data));
        assert!(shares[0] == 0.75 && shares[1..].iter().all(|share| share.is_nan()), "{shares:?}");
        let table = table(&data).unwrap();
        assert!(
            table.contains("| Goal Reaching | motors dead | 0.60 of 0.80 | 0.95 | 0.25 | 0.25 (0 and 1) |"),
            "{table}"
        );
        assert!(table.contains(", 2 published episodes each; of pairs 2."), "{table}");
        assert!(table.ends_with("trained for 5000 environment steps from the one policy on with that fault alone.\n"));
    }

    #[test]
    fn what_was_published_reads_back_and_anything_else_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(DATA_FILE);
        assert!(published(&file).unwrap().is_empty());
        let data = vec![mapped(Kind::SensorsBlind, [2, 5], 0.5)];
        std::fs::write(&file, serde_json::to_string(&data).unwrap()).unwrap();
        assert_eq!(published(&file).unwrap(), data);
        std::fs::write(&file, "[{}]").unwrap();
        let error = published(&file).err().unwrap().to_string();
        assert!(error.ends_with("map.json is not what this program publishes: delete it"), "{error}");
        let shipped = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/results/faults"));
        let data = published(&shipped.join(DATA_FILE)).unwrap();
        assert_eq!(data.len(), 5 * 3 * 36);
        assert_eq!(table(&data).unwrap(), std::fs::read_to_string(shipped.join("table.md")).unwrap());
    }

    #[test]
    fn every_module_and_every_pair_of_every_kind_has_a_cell() {
        let cells = cells(8);
        assert_eq!(cells.len(), 3 * 36);
        let drawn = |cell: &Cell| cell.plan().draw(5, 8);
        assert_eq!(drawn(&cells[0]).len(), 1);
        let pair = cells.iter().find(|cell| cell.kind == Kind::MotorsDead && cell.modules == [2, 5]).unwrap();
        let faults = drawn(pair);
        assert_eq!(
            faults.iter().map(|f| (f.fault, f.at_ns)).collect::<Vec<_>>(),
            [(Fault::ActuatorDead(2), 0), (Fault::ActuatorDead(5), 0)]
        );
        // What is written in the key reads back as the same faults.
        let again: FaultPlan = pair.plan().to_string().parse().unwrap();
        assert_eq!(again.draw(5, 8), faults);
    }
}
