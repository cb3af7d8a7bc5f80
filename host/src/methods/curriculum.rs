//! What the episodes of a run are like as it goes on: faults and variation begin when the healthy robot can do the task, faults are drawn more often
//! where they are not mastered, and a second stage goes on at a constant rate.
//!
//! All of it is decided between two iterations from the outcomes in the order of the environments, so that neither threads nor a resumption change it.
//! The environment gets a [`Lesson`] before every episode.

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};

use crate::environment::{Lesson, Outcome, TROUBLES};

/// What is left of the weight of what was seen before, an iteration later: some thirty iterations count.
const KEPT: f64 = 0.97;
/// Episodes of either outcome that every estimate begins with.
const PRIOR: f64 = 2.0;
/// Episodes without trouble that are needed to judge the healthy robot.
const ENOUGH: f64 = 30.0;

/// Settings of the curriculum. As they are by default there is none: every episode draws from the same faults and variation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CurriculumConfig {
    /// Success of the episodes without faults from which on faults and variation are drawn. Higher: they begin later, on a gait that is better by then.
    /// 0: they are there from the start.
    pub start_at: f64,
    /// Environment steps after which they begin in any case; 0: never. Higher: waits longer for a robot that does not get so good.
    pub start_by: u64,
    /// Environment steps, counted while the healthy robot succeeds as often as that, over which their share grows to the whole. Higher: gentler.
    pub ramp_steps: u64,
    /// Share of the faults that is drawn in proportion to how often episodes with that fault of that module fail; the rest is drawn evenly. Higher:
    /// more practice where it is hard, less where it is not, more of it wasted on what the body cannot do.
    pub failure_share: f64,
    /// Share of the episodes that draw from `[vary]`; the others have the robot as it should be. Higher: more robust, less exact.
    pub varied: f64,
}

impl Default for CurriculumConfig {
    fn default() -> Self {
        Self { start_at: 0.0, start_by: 0, ramp_steps: 0, failure_share: 0.0, varied: 1.0 }
    }
}

impl CurriculumConfig {
    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        for (key, value) in
            [("start_at", self.start_at), ("failure_share", self.failure_share), ("varied", self.varied)]
        {
            if !(0.0..=1.0).contains(&value) {
                bail!("curriculum.{key} is {value}; it must be from 0 to 1");
            }
        }
        Ok(())
    }
}

/// Settings of a run before the run, by the paper's protocol: the robot as it should be, of its own length, nothing broken but sensors (`blind`), nothing
/// varied, no message lost. How the task is done is learnt there, and sooner than among faults; the run itself begins with that policy, a critic of its
/// own and `sigma`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pretraining {
    /// Environment steps; they do not count in `total_steps`. Higher: a better gait to begin with. 0: there is none.
    pub steps: u64,
    /// Its learning rate at the start; it falls as that of the run does.
    pub learning_rate: f64,
    /// Its standard deviation of the actions at the start, as a fraction of the torque limit.
    pub sigma: f64,
    /// Its environments, as [`environments`](super::TrainConfig::environments) of the run. Higher: steadier, and slower at first.
    pub environments: usize,
    /// Its minibatches, as [`minibatches`](super::TrainConfig::minibatches) of the run.
    pub minibatches: usize,
    /// Share of its episodes with one module that senses zeros, 0 for the paper's protocol. No healthy module ever does, so without these what a blind one
    /// pulls is whatever the weights make of zeros, often more than the torque limit, from where the run itself learns it back slowly. Higher: a blind
    /// module does less harm, and how the task is done is learnt later.
    pub blind: f64,
}

impl Default for Pretraining {
    fn default() -> Self {
        Self { steps: 0, learning_rate: 7e-4, sigma: 0.45, environments: 32, minibatches: 4, blind: 0.0 }
    }
}

impl Pretraining {
    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        for (key, value) in [("learning_rate", self.learning_rate), ("sigma", self.sigma)] {
            if !(value.is_finite() && value > 0.0) {
                bail!("pretraining.{key} is {value}; it must be a number above 0");
            }
        }
        if !(0.0..=1.0).contains(&self.blind) {
            bail!("pretraining.blind is {}; it must be from 0 to 1", self.blind);
        }
        Ok(())
    }
}

/// Settings of the second stage of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SecondStage {
    /// Environment steps after which it begins; the learning rate of the first stage falls until then. 0: there is none.
    pub from: u64,
    /// Its learning rate, which stays, whatever `kl_target` says. Higher: learns faster and ends noisier.
    pub learning_rate: f64,
    /// The share of episodes with faults is that of the first stage times this, and at most 1. Higher: more practice with faults, less without.
    pub faults: f64,
    /// Share of the episodes that draw from `[vary]`, as `curriculum.varied` is in the first stage.
    pub varied: f64,
}

impl Default for SecondStage {
    fn default() -> Self {
        Self { from: 0, learning_rate: 2e-4, faults: 1.0, varied: 1.0 }
    }
}

impl SecondStage {
    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        if !(self.learning_rate.is_finite() && self.learning_rate > 0.0) {
            bail!("second.learning_rate is {}; it must be a number above 0", self.learning_rate);
        }
        if !(self.faults.is_finite() && self.faults >= 0.0) {
            bail!("second.faults is {}; it must be 0 or more", self.faults);
        }
        if !(0.0..=1.0).contains(&self.varied) {
            bail!("second.varied is {}; it must be from 0 to 1", self.varied);
        }
        Ok(())
    }

    /// Whether a run is in it after so many environment steps.
    pub fn has_begun(&self, steps: u64) -> bool {
        self.from > 0 && steps >= self.from
    }
}

/// Weighted episodes, and those of them that failed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Tally {
    episodes: f64,
    failed: f64,
}

impl Tally {
    fn count(&mut self, weight: f64, success: bool) {
        self.episodes += weight;
        self.failed += if success { 0.0 } else { weight };
    }

    fn fade(&mut self) {
        self.episodes *= KEPT;
        self.failed *= KEPT;
    }

    /// Share of failures, one half before anything is seen.
    fn failure(&self) -> f64 {
        (self.failed + PRIOR) / (self.episodes + 2.0 * PRIOR)
    }
}

/// Where a run is in its curriculum.
#[derive(Clone, Debug, PartialEq)]
pub struct Curriculum {
    settings: CurriculumConfig,
    second: SecondStage,
    /// Environment steps of the ramp that are behind.
    climbed: u64,
    /// Environment steps of the run.
    steps: u64,
    /// Whether faults and variation have begun.
    begun: bool,
    healthy: Tally,
    troubles: [Tally; TROUBLES],
}

impl Curriculum {
    /// At the start of a run.
    pub fn new(settings: &CurriculumConfig, second: &SecondStage) -> Self {
        Self {
            begun: settings.start_at == 0.0,
            settings: settings.clone(),
            second: second.clone(),
            climbed: 0,
            steps: 0,
            healthy: Tally::default(),
            troubles: [Tally::default(); TROUBLES],
        }
    }

    /// What the episodes that begin now are to be like.
    pub fn lesson(&self) -> Lesson {
        let share = match (self.begun, self.settings.ramp_steps) {
            (false, _) => 0.0,
            (true, 0) => 1.0,
            (true, ramp) => self.climbed as f64 / ramp as f64,
        };
        let [faults, varied] = match self.second.has_begun(self.steps) {
            true => [self.second.faults, self.second.varied],
            false => [1.0, self.settings.varied],
        };
        Lesson {
            faults: (share * faults) as f32,
            varied: (share * varied) as f32,
            failure_share: self.settings.failure_share as f32,
            failure: self.troubles.map(|tally| tally.failure() as f32),
        }
    }

    /// Takes in the episodes that ended in an iteration of so many environment steps.
    pub fn take<'a>(&mut self, episodes: impl Iterator<Item = &'a Outcome>, steps: u64) {
        self.steps += steps;
        self.healthy.fade();
        self.troubles.iter_mut().for_each(Tally::fade);
        for Outcome { success, troubles, .. } in episodes {
            if *troubles == 0 {
                self.healthy.count(1.0, *success);
            }
            // Who shares an episode shares the blame.
            let weight = 1.0 / f64::from(troubles.count_ones().max(1));
            for (index, tally) in self.troubles.iter_mut().enumerate() {
                if troubles >> index & 1 == 1 {
                    tally.count(weight, *success);
                }
            }
        }
        let waited = self.settings.start_by > 0 && self.steps >= self.settings.start_by;
        let good = waited || self.healthy.episodes >= ENOUGH && 1.0 - self.healthy.failure() >= self.settings.start_at;
        self.begun |= good;
        if good || (self.begun && self.settings.start_at == 0.0) {
            self.climbed = (self.climbed + steps).min(self.settings.ramp_steps);
        }
    }

    /// What is logged of it.
    pub fn scalars(&self) -> Vec<(String, f64)> {
        let lesson = self.lesson();
        let failures = self.troubles.iter().map(Tally::failure);
        vec![
            ("curriculum/faults".into(), f64::from(lesson.faults)),
            ("curriculum/varied".into(), f64::from(lesson.varied)),
            ("curriculum/healthy_success".into(), 1.0 - self.healthy.failure()),
            ("curriculum/worst_fault_failure".into(), failures.fold(0.0, f64::max)),
        ]
    }

    /// All numbers it is made of; [`Curriculum::restore`] takes them back.
    pub fn numbers(&self) -> impl Iterator<Item = f64> {
        let tallies = std::iter::once(&self.healthy).chain(&self.troubles).flat_map(|t| [t.episodes, t.failed]);
        [self.climbed as f64, self.steps as f64, f64::from(u8::from(self.begun))].into_iter().chain(tallies)
    }

    /// Goes back to what it was; none if there are too few numbers.
    pub fn restore(&mut self, numbers: &mut impl Iterator<Item = f64>) -> Option<()> {
        self.climbed = numbers.next()? as u64;
        self.steps = numbers.next()? as u64;
        self.begun = numbers.next()? != 0.0;
        for tally in std::iter::once(&mut self.healthy).chain(&mut self.troubles) {
            *tally = Tally { episodes: numbers.next()?, failed: numbers.next()? };
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(troubles: u32, success: bool) -> Outcome {
        Outcome { troubles, success, ..Outcome::default() }
    }

    #[test]
    fn faults_begin_when_the_healthy_robot_succeeds_and_grow_slowly() {
        let settings = CurriculumConfig { start_at: 0.7, ramp_steps: 400, varied: 0.5, ..Default::default() };
        let second = SecondStage { from: 1000, faults: 1.5, ..Default::default() };
        let mut curriculum = Curriculum::new(&settings, &second);
        let shares = |curriculum: &Curriculum| [curriculum.lesson().faults, curriculum.lesson().varied];
        curriculum.take([outcome(0, false); 40].iter(), 100);
        assert_eq!(shares(&curriculum), [0.0, 0.0]);
        for expected in [[0.25, 0.125], [0.5, 0.25]] {
            curriculum.take([outcome(0, true); 200].iter(), 100);
            assert_eq!(shares(&curriculum), expected);
        }
        // While the healthy robot is worse again they stay as they are.
        curriculum.take([outcome(0, false); 400].iter(), 100);
        assert_eq!(shares(&curriculum), [0.5, 0.25]);
        curriculum.take([outcome(0, true); 4000].iter(), 600);
        assert_eq!(shares(&curriculum), [1.5, 1.0]);
        // Whoever has waited long enough begins with a robot that fails.
        let mut waiting = Curriculum::new(&CurriculumConfig { start_by: 200, ..settings }, &SecondStage::default());
        for expected in [0.0, 0.25, 0.5] {
            waiting.take([outcome(0, false); 40].iter(), 100);
            assert_eq!(waiting.lesson().faults, expected);
        }
    }

    #[test]
    fn what_fails_is_known_by_kind_and_place_and_shared_blame_is_divided() {
        let mut curriculum = Curriculum::new(&CurriculumConfig::default(), &SecondStage::default());
        assert!(curriculum.lesson().failure.iter().all(|failure| *failure == 0.5));
        curriculum.take([outcome(1, true); 96].iter().chain(&[outcome(0b110, false); 4]), 100);
        let failure = curriculum.lesson().failure;
        assert_eq!([failure[0], failure[1], failure[2], failure[3]], [2.0 / 100.0, 4.0 / 6.0, 4.0 / 6.0, 0.5]);
        // From the start all of it is there.
        assert_eq!((curriculum.lesson().faults, curriculum.lesson().varied), (1.0, 1.0));
    }

    #[test]
    fn it_comes_back_from_its_numbers() {
        let settings = CurriculumConfig { start_at: 0.5, ramp_steps: 1000, ..Default::default() };
        let mut curriculum = Curriculum::new(&settings, &SecondStage::default());
        curriculum.take([outcome(1, true), outcome(0, true), outcome(8, false)].iter().cycle().take(200), 128);
        let mut other = Curriculum::new(&settings, &SecondStage::default());
        assert_ne!(curriculum, other);
        other.restore(&mut curriculum.numbers()).unwrap();
        assert_eq!(curriculum, other);
        assert_eq!(other.restore(&mut curriculum.numbers().take(20)), None);
    }

    #[test]
    fn settings_are_checked() {
        for (text, complaint) in [
            ("start_at = 1.5", "curriculum.start_at is 1.5; it must be from 0 to 1"),
            ("failure_share = -0.1", "curriculum.failure_share is -0.1"),
            ("varied = nan", "curriculum.varied is NaN"),
        ] {
            let error = toml::from_str::<CurriculumConfig>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(complaint), "{error}");
        }
        for (text, complaint) in [
            ("learning_rate = 0.0", "second.learning_rate is 0; it must be a number above 0"),
            ("faults = -1.0", "second.faults is -1; it must be 0 or more"),
            ("varied = 2.0", "second.varied is 2; it must be from 0 to 1"),
        ] {
            let error = toml::from_str::<SecondStage>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(complaint), "{error}");
        }
        for (text, complaint) in [
            ("learning_rate = inf", "pretraining.learning_rate is inf; it must be a number above 0"),
            ("sigma = 0.0", "pretraining.sigma is 0; it must be a number above 0"),
        ] {
            let error = toml::from_str::<Pretraining>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(complaint), "{error}");
        }
    }
}
