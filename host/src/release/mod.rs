//! The policies that ship: each task is trained with several seeds, frozen and measured; the policy of the median success over all rows on the robot's own
//! length ships, and its manifest says what the others can do.

pub mod export;
pub mod measured;
pub mod published;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use composer_shared::policy::{Policy, Task};

use crate::files::{create_folder, write_whole};
use crate::freeze::Parity;
use crate::policy_source::PolicySource;
use crate::rows::Rows;
use crate::run::RunConfig;
use crate::run_folder::{
    CALIBRATION_EPISODES, CONFIG_FILE, NETWORK_FILE, begun, freeze_run, load_config, metrics_with_pretraining, trained,
    wall_seconds,
};
use crate::side_by_side::{cores, side_by_side};
use export::{Exported, Manifest, SeedRows};
use measured::{Measured, measure, rows, world};
use published::{Published, published, tables, with_new};

/// The image of a run that has been trained to its end, in its folder.
const IMAGE_FILE: &str = "frozen.policy";
/// What was measured of it.
const ROWS_FILE: &str = "measured.json";
/// What every seed came to, in the folder for the tables.
const DATA_FILE: &str = "seeds.json";
/// The tables, beside it.
const TABLE_FILE: &str = "table.md";
/// Most bytes of the metrics that ship with a policy.
const METRICS_BYTES: usize = 300_000;

/// What is to be released, and where.
#[derive(Clone, Debug)]
pub struct Release {
    /// Tasks.
    pub tasks: Vec<Task>,
    /// Seeds of each, from 1 on.
    pub seeds: u64,
    /// Runs side by side, each on its share of the cores; none: the cores.
    pub jobs: Option<u64>,
    /// Trains nothing: freezes and measures what the runs have come to.
    pub only_freeze: bool,
    /// Settings of every run that differ from those of the files, `key=value`.
    pub settings: Vec<String>,
    /// Episodes of each row, the first of the published ones.
    pub episodes: u64,
    /// Folder of the settings, `TASK.toml`.
    pub configs: PathBuf,
    /// Folder of the training runs.
    pub runs: PathBuf,
    /// Folder that the policies ship from.
    pub ship: PathBuf,
    /// Folder for the tables and the data.
    pub out: PathBuf,
}

/// A task with one seed.
struct Run {
    task: Task,
    folder: PathBuf,
    config: RunConfig,
}

/// What a run came to.
struct Done<'a> {
    run: &'a Run,
    config: RunConfig,
    image: Vec<u8>,
    parity: Parity,
    measured: Vec<Measured>,
}

impl Done<'_> {
    fn overall(&self) -> f64 {
        overall(&self.measured)
    }

    fn seed(&self) -> u64 {
        self.config.train.seed
    }

    fn published(&self, ships: bool) -> Published {
        Published {
            task: self.run.task,
            seed: self.seed(),
            ships,
            crc32: format!("{:08x}", crc(&self.image)),
            environment_steps: self.config.environment_steps(),
            wall_seconds: wall_seconds(&self.run.folder),
            parity: self.parity,
            measured: self.measured.clone(),
        }
    }
}

/// Trains, freezes, measures, ships and publishes what is not done yet; the tables. None: interrupted, the same call goes on.
pub fn release(release: &Release) -> Result<Option<String>> {
    let runs = planned(release)?;
    // Read first: what cannot be read is said before hours of training.
    let before = published(&release.out.join(DATA_FILE))?;
    for folder in [&release.runs, &release.ship, &release.out] {
        create_folder(folder)?;
    }
    let folders: Vec<&Path> = runs.iter().map(|run| &*run.folder).collect();
    if !side_by_side(&folders, release.jobs, |number, threads| finish(&runs[number], release, threads).map(drop))? {
        return Ok(None);
    }
    let mut shipped = Vec::new();
    for &task in &release.tasks {
        let mut done = Vec::new();
        for run in runs.iter().filter(|run| run.task == task) {
            // Everything is there already, so that this only reads.
            done.push(finish(run, release, cores())?.context("a run is not finished")?);
        }
        done.sort_by_key(Done::seed);
        shipped.push(ship(done, &release.ship)?);
    }
    publish(&shipped, before, &release.out).map(Some)
}

/// Measures again what was published, without its runs: every seed whose image is there. For physics, tasks or rows that have changed. The tables.
pub fn measure_again(release: &Release) -> Result<String> {
    let data_file = release.out.join(DATA_FILE);
    let mut data = published(&data_file)?;
    for number in 0..data.len() {
        let one = &mut data[number];
        if !release.tasks.contains(&one.task) {
            continue;
        }
        let shipped = release.ship.join(format!("{}.policy", one.task));
        let file = if one.ships { shipped.clone() } else { image_file(&release.out, one.task, one.seed) };
        let Ok(image) = std::fs::read(&file) else {
            eprintln!("note: {} is not there: the rows of this seed stay as they were", file.display());
            continue;
        };
        if format!("{:08x}", crc(&image)) != one.crc32 {
            bail!("{} is not the policy that {} tells of, {}", file.display(), data_file.display(), one.crc32);
        }
        eprintln!("{}", file.display());
        // All seeds of a task are trained for the same.
        let source = PolicySource::load(&shipped.display().to_string())?;
        let env = source.environment(None, None)?;
        let measure = |row| measure(&env, &image, row, release.episodes, cores());
        one.measured = rows(one.task, env.robot.modules).into_iter().map(measure).collect::<Result<_>>()?;
        let mut manifest = Manifest::read(&shipped)?;
        manifest.measured_anew(one.seed, &one.measured);
        manifest.write(&shipped)?;
        // Each by itself: whoever stops it keeps what is done.
        write_whole(&data_file, serde_json::to_string_pretty(&data)?.as_bytes())?;
    }
    let table = tables(&data)?;
    write_whole(&release.out.join(TABLE_FILE), table.as_bytes())?;
    Ok(table)
}

/// Where the image of a seed is published, if it does not ship.
fn image_file(out: &Path, task: Task, seed: u64) -> PathBuf {
    out.join(format!("{task}-{seed}.policy"))
}

/// The runs, the longest first, so that none is left to run alone at the end.
fn planned(release: &Release) -> Result<Vec<Run>> {
    let mut runs = Vec::new();
    for &task in &release.tasks {
        let file = release.configs.join(format!("{task}.toml"));
        let mut config = load_config(&file)?;
        if config.task.name != task {
            bail!("{} has settings for {}, not for {task}", file.display(), config.task.name);
        }
        for setting in &release.settings {
            config.set(setting)?;
        }
        for seed in 1..=release.seeds {
            config.train.seed = seed;
            config.validate()?;
            let folder = release.runs.join(format!("{task}-{seed}"));
            runs.push(Run { task, folder, config: config.clone() });
        }
    }
    if release.only_freeze {
        runs.retain(|run| run.folder.join(NETWORK_FILE).exists());
        if let Some(task) = release.tasks.iter().find(|task| !runs.iter().any(|run| run.task == **task)) {
            bail!("{} holds no run of {task} to freeze: without --only-freeze it is trained", release.runs.display());
        }
    }
    runs.sort_by_key(|run| std::cmp::Reverse(run.config.environment_steps()));
    Ok(runs)
}

/// Trains, freezes and measures a run as far as that is not done; none if it was interrupted.
fn finish<'a>(run: &'a Run, release: &Release, threads: usize) -> Result<Option<Done<'a>>> {
    let (image_file, folder) = (run.folder.join(IMAGE_FILE), &run.folder);
    begun(folder, &run.config)?;
    let rows_kept = |folder: &Path| Rows::open(&folder.join(ROWS_FILE));
    let freeze = || -> Result<(RunConfig, Vec<u8>, Parity)> { freeze_run(folder, CALIBRATION_EPISODES, threads) };
    let (config, image, parity) = match std::fs::read(&image_file) {
        Ok(image) if Policy::parse(&image).is_ok() && !release.only_freeze => {
            let parity = rows_kept(folder)?.get(&parity_key(&image), || Ok(freeze()?.2))?;
            (load_config(&folder.join(CONFIG_FILE))?, image, parity)
        }
        _ => {
            if !release.only_freeze && !trained(folder, &run.config, threads)? {
                return Ok(None);
            }
            let (config, image, parity) = freeze()?;
            rows_kept(folder)?.get(&parity_key(&image), || Ok(parity))?;
            if !release.only_freeze {
                write_whole(&image_file, &image)?;
            }
            (config, image, parity)
        }
    };
    let (kept, env) = (rows_kept(folder)?, config.evaluation());
    let world = world(&env);
    let measured = rows(config.task.name, config.robot.modules)
        .into_iter()
        .map(|row| {
            let key = format!("{:08x} {row} episodes={} world={world:08x}", crc(&image), release.episodes);
            kept.get(&key, || measure(&env, &image, row, release.episodes, threads))
        })
        .collect::<Result<Vec<_>>>()?;
    Ok(Some(Done { run, config, image, parity, measured }))
}

fn parity_key(image: &[u8]) -> String {
    format!("{:08x} parity", crc(image))
}

fn crc(image: &[u8]) -> u32 {
    Policy::parse(image).map_or(0, |policy| policy.crc())
}

/// Mean success over the rows on the robot's own length, whole and broken, nominal and varied. The healthy row alone would choose by chance among seeds
/// that nearly always succeed.
fn overall(measured: &[Measured]) -> f64 {
    let own = measured.first().map_or(0, |row| row.modules);
    let rows = || measured.iter().filter(|row| row.modules == own);
    rows().map(|row| row.success_rate).sum::<f64>() / rows().count().max(1) as f64
}

/// The number of the median success; of an even number the lower one, of equals the earlier seed.
fn median(success: &[f64]) -> usize {
    let mut order: Vec<usize> = (0..success.len()).collect();
    order.sort_by(|a, b| success[*a].total_cmp(&success[*b]));
    order[(order.len() - 1) / 2]
}

/// A task with all its seeds; the number of the one that ships.
struct Shipped<'a> {
    seeds: Vec<Done<'a>>,
    chosen: usize,
}

/// Writes the policy of the median success ([`overall`]).
fn ship<'a>(seeds: Vec<Done<'a>>, to: &Path) -> Result<Shipped<'a>> {
    let chosen = median(&seeds.iter().map(Done::overall).collect::<Vec<_>>());
    let rows = seeds.iter().map(|done| SeedRows { seed: done.seed(), measured: done.measured.clone() }).collect();
    let done = &seeds[chosen];
    let folder = &done.run.folder;
    let metrics = metrics_with_pretraining(folder)?;
    let exported = Exported {
        config: done.config.clone(),
        run: folder,
        image: &done.image,
        parity: done.parity,
        measured: done.measured.clone(),
        seeds: rows,
    };
    let path = to.join(format!("{}.policy", done.run.task));
    exported.write(&path, thinned(&metrics, METRICS_BYTES).as_bytes())?;
    Ok(Shipped { seeds, chosen })
}

/// As many lines of metrics as fit into so many bytes: those with an evaluation and the last, and of the others every second, third and so on. If that is
/// too much still, of those with an evaluation as well.
fn thinned(metrics: &str, most: usize) -> String {
    let lines: Vec<&str> = metrics.lines().collect();
    for every in 1..=lines.len() {
        for keep_evaluations in [true, false] {
            let kept = lines.iter().enumerate().filter(|(number, line)| {
                number % every == 0 || *number + 1 == lines.len() || keep_evaluations && line.contains("\"evaluation/")
            });
            let text: String = kept.map(|(_, line)| format!("{line}\n")).collect();
            // Evaluations go only when hardly anything else is left.
            if text.len() <= most && (keep_evaluations || every >= 50 || every == lines.len()) {
                return text;
            }
        }
    }
    String::new()
}

/// Writes the tables, the data and the images that do not ship. Of tasks that were not asked for what was published before stays.
fn publish(shipped: &[Shipped], before: Vec<Published>, out: &Path) -> Result<String> {
    let new = shipped.iter().flat_map(|task| {
        task.seeds.iter().enumerate().map(move |(number, done)| done.published(number == task.chosen))
    });
    let data = with_new(before, new.collect());
    for task in shipped {
        for (number, done) in task.seeds.iter().enumerate() {
            let file = image_file(out, done.run.task, done.seed());
            if number == task.chosen {
                // One of before that ships now stands in the folder for that.
                let _ = std::fs::remove_file(file);
            } else {
                write_whole(&file, &done.image)?;
            }
        }
    }
    let table = tables(&data)?;
    write_whole(&out.join(DATA_FILE), serde_json::to_string_pretty(&data)?.as_bytes())?;
    write_whole(&out.join(TABLE_FILE), table.as_bytes())?;
    Ok(table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_ships() {
        let row = |modules, success_rate| Measured { modules, success_rate, ..Measured::default() };
        assert_eq!(overall(&[row(8, 1.0), row(8, 0.5), row(16, 0.0)]), 0.75);
        assert_eq!(median(&[0.9, 0.2, 0.5]), 2);
        assert_eq!(median(&[0.9, 0.2]), 1);
        assert_eq!((median(&[0.7]), median(&[0.5, 0.5, 0.5])), (0, 1));
    }

    #[test]
    fn tables_and_readme_are_of_the_data_that_is_published() {
        let host = Path::new(env!("CARGO_MANIFEST_DIR"));
        let text = |file: &str| std::fs::read_to_string(host.join(file)).unwrap();
        let data = published(&host.join("results/policies").join(DATA_FILE)).unwrap();
        assert_eq!(tables(&data).unwrap(), text("results/policies/table.md"));
        let readme = text("../README.md");
        for line in (text("results/policies/table.md") + &text("results/physics/policies.md")).lines() {
            assert!(readme.lines().any(|own| own == line), "README.md lacks `{line}`");
        }
        for one in data.iter().filter(|one| one.ships) {
            let policy = composer_shared::policies::shipped(one.task.name()).unwrap();
            assert_eq!(format!("{:08x}", crc(policy)), one.crc32, "{}", one.task);
        }
    }

    #[test]
    fn what_was_published_is_measured_again_where_its_image_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let (ship, out) = (folder.path().join("ship"), folder.path().join("out"));
        let task = Task::TubeCrossing;
        let settings = Release {
            tasks: vec![task],
            seeds: 3,
            jobs: None,
            only_freeze: false,
            settings: Vec::new(),
            episodes: 1,
            configs: PathBuf::new(),
            runs: PathBuf::new(),
            ship: ship.clone(),
            out: out.clone(),
        };
        create_folder(&ship).unwrap();
        create_folder(&out).unwrap();
        let image = composer_shared::policies::shipped(task.name()).unwrap();
        let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/policies/tube-crossing.policy");
        let mut manifest = Manifest::read(Path::new(shipped)).unwrap();
        let own: u64 = 1;
        let old = || vec![Measured { fault: "none".into(), modules: 8, success_rate: 0.125, ..Measured::default() }];
        [1, 2, 3].into_iter().for_each(|seed| manifest.measured_anew(seed, &old()));
        std::fs::write(ship.join("tube-crossing.policy"), image).unwrap();
        manifest.write(&ship.join("tube-crossing.policy")).unwrap();
        std::fs::write(image_file(&out, task, 2), image).unwrap();
        let one = |seed| Published {
            task,
            seed,
            ships: seed == own,
            crc32: format!("{:08x}", crc(image)),
            environment_steps: 0,
            wall_seconds: 0.0,
            parity: Parity::of(vec![0.0]),
            measured: old(),
        };
        let other = Published { task: Task::GoalReaching, ..one(1) };
        let write = |data: &[Published]| write_whole(&out.join(DATA_FILE), &serde_json::to_vec(data).unwrap()).unwrap();
        write(&[other.clone(), one(1), one(2), one(3)]);
        let table = measure_again(&settings).unwrap();
        let data = published(&out.join(DATA_FILE)).unwrap();
        let rows_of = |number: usize| data[number].measured.len();
        // Another task and a seed without an image have what they had.
        assert_eq!((rows_of(0), rows_of(1), rows_of(2), rows_of(3)), (1, 13, 13, 1));
        assert_eq!(data[1].measured, data[2].measured);
        assert!(table.contains("| Tube Crossing | 3 | 0.125 ") && !table.contains("| Tube Crossing | 2 | 0.125 "));
        let manifest = std::fs::read_to_string(ship.join("tube-crossing.toml")).unwrap();
        assert_eq!(manifest.matches("success_rate = 0.125").count(), 1);
        write(&[Published { crc32: "00000000".into(), ..one(1) }]);
        let error = measure_again(&settings).unwrap_err().to_string();
        assert!(error.contains("tube-crossing.policy is not the policy that"), "{error}");
    }

    #[test]
    fn metrics_are_thinned_to_the_evaluations_and_evenly() {
        let line = |n: usize| match n % 50 {
            0 => format!("{{\"step\":{n},\"evaluation/success_rate\":0.5}}\n"),
            _ => format!("{{\"step\":{n},\"charts/success_rate\":0.5}}\n"),
        };
        let metrics: String = (0..1001).map(line).collect();
        assert_eq!(thinned(&metrics, metrics.len()), metrics);
        let short = thinned(&metrics, 10_000);
        assert!(short.len() <= 10_000 && short.len() > 6_000, "{}", short.len());
        assert_eq!(short.matches("evaluation/").count(), 21);
        assert!(short.ends_with(&line(1000)) && short.starts_with(&line(0)));
        assert!(thinned(&metrics, 500).len() <= 500 && thinned(&metrics, 500).contains("\"step\":1000,"));
    }
}
