//! Replays: one self-contained HTML file in which an episode can be watched, offline, in any browser.
//!
//! A [`Recording`] collects [`Episode`]s, an episode its [`Setting`] and one [`FrameRecord`] a control step; [`Recording::write_html`] quantises
//! them and puts them into `page.html`, which holds all of its script and style itself. The page interpolates between frames.
//!
//! Units and frames are those of the robot ([`composer_shared::robot`]): robot units, seconds, world z up, the ground at
//! z = 0; a link's x axis points towards the head. Rotations are quaternions in the order x, y, z, w.
//!
//! The page opens at a place that its address names: `replay.html#t=3.2&episode=2&top` (seconds; episodes count from 1).
//! Also understood: `follow`, `nums=0`, `theme=dark`, `theme=light`, `pause`, and `2d` for the view that needs no WebGL.
//! Scripts find `window.__replay` with `ready`, `frames`, `episodes`, `time`, `lastError`, `seek(seconds)`, `play()`,
//! `pause()` and `setEpisode(index from 0)`; the root element carries `data-ready`, `data-frames`, `data-error`.
//!
//! Size: a frame costs 14 bytes a link, 3 a module, one an entry of the attention matrix, and a third more for base64.
//! 125 frames of 8 modules with 4 links are about 90 kB on top of the page.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::files;

const PAGE: &str = include_str!("page.html");
/// Finest step of a recorded position, robot units. Recordings wider than 65 units get a coarser one.
const POSITION_STEP: f32 = 0.001;

/// Why a replay could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The recording has no episode, or an episode has no frame.
    #[error("cannot write the replay: {0}")]
    Empty(String),
    /// A frame does not fit the robot and the scene of its recording.
    #[error("cannot write the replay: frame {frame} of episode {episode:?} {what}")]
    Frame {
        /// Name of the episode.
        episode: String,
        /// Index of the frame, from 0.
        frame: usize,
        /// What is wrong with it, and what would be right.
        what: String,
    },
    /// The robot or the scene of the recording makes no sense.
    #[error("cannot write the replay: {0}")]
    Header(String),
    /// The file could not be written.
    #[error("cannot write the replay {}: {what} ({source})", path.display())]
    Write {
        /// The file asked for.
        path: PathBuf,
        /// What would have to be different.
        what: String,
        /// The system's own words.
        source: io::Error,
    },
}

/// A position (robot units) and a rotation (quaternion x, y, z, w) in the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Pose {
    /// Where the centre is, robot units.
    pub position: [f32; 3],
    /// How it is turned, quaternion x, y, z, w.
    pub rotation: [f32; 4],
}

impl Pose {
    /// Not turned.
    pub fn at(position: [f32; 3]) -> Self {
        Pose { position, rotation: [0.0, 0.0, 0.0, 1.0] }
    }

    fn is_finite(&self) -> bool {
        self.position.iter().chain(&self.rotation).all(|v| v.is_finite())
    }
}

/// The robot as the page draws it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Robot {
    /// Modules, numbered from the head.
    pub modules: usize,
    /// Links in one module.
    pub links_per_module: usize,
    /// Distance between two neighbouring joints, robot units.
    pub link_length: f32,
    /// Radius of a link, robot units.
    pub link_radius: f32,
    /// Torque at which the page's torque bars are full.
    pub torque_limit: f32,
    /// Length of a robot unit in metres, for the scale bar.
    pub metres_per_unit: f32,
}

/// Outline of a [`Shape`]; sizes in robot units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outline {
    /// A box, by half its edges along x, y, z.
    Box {
        /// Half of each edge.
        half: [f32; 3],
    },
    /// A solid cylinder along its own x axis.
    Cylinder {
        /// Radius.
        radius: f32,
        /// Half of its length.
        half_length: f32,
    },
    /// A piece of an open tube along its own x axis.
    Tube {
        /// Inner radius.
        radius: f32,
        /// Half of its length.
        half_length: f32,
    },
    /// A ball.
    Sphere {
        /// Radius.
        radius: f32,
    },
}

/// How a [`Shape`] looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Look {
    /// Something there.
    Solid,
    /// Something there that one has to see through: the wall of a tube.
    Glass,
    /// Something wanted rather than something there: a target.
    Wanted,
}

/// Something in the scene besides the snake: a wall, a block, a panel of a tube, a wanted place.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// Its outline.
    pub outline: Outline,
    /// Where it is; for a shape that moves, only until the first frame says otherwise.
    pub pose: Pose,
    /// How it looks.
    pub look: Look,
    /// Every frame gives its pose, in [`FrameRecord::moving`].
    pub moves: bool,
    /// A word beside it; empty for none. Numbers are hidden with the numbers of the modules.
    pub label: String,
}

/// What an episode is about, and what stands on the ground in it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Setting {
    /// The task's name.
    pub task: String,
    /// What [`FrameRecord::distance`] is the distance of, such as "block to goal".
    pub measure: String,
    /// The distance below which the task is done, robot units; 0 where that is not all.
    pub threshold: f32,
    /// Radius of the ball to be reached round the goal, robot units; 0 where the goal is only a direction.
    pub goal_radius: f32,
    /// What is there besides the snake.
    pub scene: Vec<Shape>,
}

/// What a module is able to do at a time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(u8)]
pub enum Status {
    /// Nothing is wrong.
    #[default]
    Ok = 0,
    /// Off the bus and without power.
    Unplugged = 1,
    /// It thinks, but its motors do not turn.
    ActuatorDead = 2,
    /// Its sensors are zeroed, stuck or implausible.
    SensorFault = 3,
    /// It switched its own motors off: isolated, too hot or stopped.
    Relaxed = 4,
}

/// One control step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameRecord {
    /// Time in the episode, seconds; grows from frame to frame.
    pub time: f32,
    /// Every link from the head to the tail.
    pub links: Vec<Pose>,
    /// Every module's status.
    pub status: Vec<Status>,
    /// Every module's torques (yaw, pitch), in the unit of [`Robot::torque_limit`].
    pub torques: Vec<[f32; 2]>,
    /// Where the goal is, if the task has one.
    pub goal: Option<[f32; 3]>,
    /// What success is measured by, robot units; not a number where there is nothing to show.
    pub distance: f32,
    /// Attention matrix, row-major, 255 for a weight of 1: row = attending module, column = module attended to
    /// (the paper's A, section IV-D). See [`attention_bytes`].
    pub attention: Option<Vec<u8>>,
    /// Poses of the scene's shapes that move, in the order of the scene.
    pub moving: Vec<Pose>,
}

/// Attention weights (0 to 1) as the bytes of a [`FrameRecord`].
pub fn attention_bytes(weights: &[f32]) -> Vec<u8> {
    weights.iter().map(|w| (w * 255.0).round() as u8).collect()
}

/// Something that happened at a time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Seconds since the episode began.
    pub time: f32,
    /// A few words, such as "module 3 unplugged".
    pub text: String,
}

/// One episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    name: String,
    setting: Setting,
    frames: Vec<FrameRecord>,
    events: Vec<Event>,
    summary: Vec<(String, String)>,
}

impl Episode {
    /// An episode without frames. The name is what the page's selector shows.
    pub fn new(name: impl Into<String>, setting: Setting) -> Self {
        Episode { name: name.into(), setting, ..Episode::default() }
    }

    /// Adds a control step. Cheap: nothing is checked or encoded before the recording is written.
    pub fn push(&mut self, frame: FrameRecord) {
        self.frames.push(frame);
    }

    /// Adds something that happened.
    pub fn event(&mut self, time: f32, text: impl Into<String>) {
        self.events.push(Event { time, text: text.into() });
    }

    /// Adds a line to the episode's table, such as ("reached", "after 4.05 s").
    pub fn note(&mut self, name: impl Into<String>, value: impl Into<String>) {
        self.summary.push((name.into(), value.into()));
    }

    /// What it is about, and what stands there.
    pub fn setting(&self) -> &Setting {
        &self.setting
    }

    /// Its control steps.
    pub fn frames(&self) -> &[FrameRecord] {
        &self.frames
    }

    /// Control steps so far.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there is no control step yet.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }
}

/// Everything that goes into one replay file.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    title: String,
    robot: Robot,
    summary: Vec<(String, String)>,
    episodes: Vec<Episode>,
}

impl Recording {
    /// A recording without episodes.
    pub fn new(title: impl Into<String>, robot: Robot) -> Self {
        Recording { title: title.into(), robot, summary: Vec::new(), episodes: Vec::new() }
    }

    /// Adds a line to the table that holds for all episodes, such as ("bus", "CAN-FD 1M/5M").
    pub fn note(&mut self, name: impl Into<String>, value: impl Into<String>) {
        self.summary.push((name.into(), value.into()));
    }

    /// Adds an episode.
    pub fn push(&mut self, episode: Episode) {
        self.episodes.push(episode);
    }

    /// The page as text.
    ///
    /// # Errors
    /// When there is nothing to show or a frame does not fit the robot and the scene.
    pub fn to_html(&self) -> Result<String, ReplayError> {
        Ok(self.page_of(&self.encoded()?))
    }

    /// Its episodes as the page reads them, in JSON: what [`Recording::page_of`] puts together, elsewhere or later.
    ///
    /// # Errors
    /// As [`Recording::to_html`].
    pub fn encoded(&self) -> Result<Vec<String>, ReplayError> {
        self.check()?;
        let json = |e| serde_json::to_string(&self.encode(e)).expect("plain data encodes");
        Ok(self.episodes.iter().map(json).collect())
    }

    /// The page with these encoded episodes of such a robot instead of its own.
    pub fn page_of(&self, encoded: &[String]) -> String {
        let data = PageData { format: 2, title: &self.title, robot: &self.robot, summary: &self.summary };
        let head = serde_json::to_string(&data).expect("plain data encodes");
        let head = head.strip_suffix('}').expect("an object ends so");
        // Text cannot close the script element or open a comment in it: '<' appears in JSON strings only.
        let json = format!("{head},\"episodes\":[{}]}}", encoded.join(",")).replace('<', "\\u003c");
        let title = self.title.replace('&', "&amp;").replace('<', "&lt;");
        let page = PAGE.replacen("@TITLE@", &title, 1);
        page.replacen("@RECORDING@", &json, 1)
    }

    /// Writes the page to `path`. It is complete or it is not there: a temporary file in the same folder is renamed.
    ///
    /// # Errors
    /// As [`Recording::to_html`], and when the folder is missing, not writable or full.
    pub fn write_html(&self, path: &Path) -> Result<(), ReplayError> {
        let html = self.to_html()?;
        let folder = match path.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        let fail = |what: String| move |source| ReplayError::Write { path: path.to_path_buf(), what, source };
        if path.is_dir() {
            let source = io::Error::from(io::ErrorKind::IsADirectory);
            return Err(fail("it is a folder; name a file in it, such as replay.html".into())(source));
        }
        match fs::metadata(folder) {
            Ok(m) if m.is_dir() => {}
            Ok(_) => {
                let source = io::Error::from(io::ErrorKind::NotADirectory);
                return Err(fail(format!("{} is not a folder", folder.display()))(source));
            }
            Err(e) => return Err(fail(format!("make the folder {} first", folder.display()))(e)),
        }
        let size = html.len().div_ceil(1000);
        files::replace(path, html.as_bytes()).map_err(fail(format!(
            "choose a folder that is writable and has {size} kB of room, {} is not",
            folder.display()
        )))
    }

    fn check(&self) -> Result<(), ReplayError> {
        let robot = &self.robot;
        let sizes = [robot.link_length, robot.link_radius, robot.torque_limit, robot.metres_per_unit];
        if robot.modules == 0 || robot.links_per_module == 0 || sizes.iter().any(|v| !v.is_finite() || *v <= 0.0) {
            return Err(ReplayError::Header(format!(
                "every number of the robot must be greater than zero, got {robot:?}"
            )));
        }
        if self.episodes.is_empty() {
            return Err(ReplayError::Empty("it has no episode; record at least one".into()));
        }
        for episode in &self.episodes {
            let setting = &episode.setting;
            let moving = setting.scene.iter().filter(|s| s.moves).count();
            setting.check().map_err(|what| ReplayError::Header(format!("episode {:?} {what}", episode.name)))?;
            if episode.frames.is_empty() {
                return Err(ReplayError::Empty(format!("episode {:?} has no frame", episode.name)));
            }
            let mut before = f32::NEG_INFINITY;
            for (index, frame) in episode.frames.iter().enumerate() {
                frame
                    .check(robot, moving)
                    .and_then(|()| {
                        if frame.time > before {
                            Ok(())
                        } else {
                            Err(format!("is at {} s, not later than the frame before it ({before} s)", frame.time))
                        }
                    })
                    .map_err(|what| ReplayError::Frame { episode: episode.name.clone(), frame: index, what })?;
                before = frame.time;
            }
        }
        Ok(())
    }

    fn encode<'a>(&self, episode: &'a Episode) -> PageEpisode<'a> {
        let frames = &episode.frames;
        let positions = || frames.iter().flat_map(|f| &f.links).map(|p| p.position);
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for p in positions() {
            for axis in 0..3 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
        }
        let origin: [f32; 3] = std::array::from_fn(|a| (low[a] + high[a]) / 2.0);
        let half = (0..3).map(|a| (high[a] - low[a]) / 2.0).fold(0.0, f32::max);
        let step = POSITION_STEP.max(half / f32::from(i16::MAX - 1));

        let mut links = Bytes::default();
        let mut status = Bytes::default();
        let mut torque = Bytes::default();
        let mut attention = Bytes::default();
        let mut moving = Bytes::default();
        let has_attention = frames.iter().any(|f| f.attention.is_some());
        let entries = self.robot.modules * self.robot.modules;
        for frame in frames {
            for pose in &frame.links {
                for (p, o) in pose.position.iter().zip(origin) {
                    links.i16((p - o) / step);
                }
                // A quaternion may come slightly off unit length; the page normalises after interpolation.
                pose.rotation.iter().for_each(|r| links.i16(r * 32767.0));
            }
            status.0.extend(frame.status.iter().map(|s| *s as u8));
            for t in frame.torques.iter().flatten() {
                // `as` saturates, and turns "not a number" into 0.
                torque.0.push((t / self.robot.torque_limit * 127.0).round().clamp(-127.0, 127.0) as i8 as u8);
            }
            if has_attention {
                match &frame.attention {
                    Some(matrix) => attention.0.extend(matrix),
                    None => attention.0.resize(attention.0.len() + entries, 0),
                }
            }
            frame.moving.iter().for_each(|p| p.position.iter().chain(&p.rotation).for_each(|v| moving.f32(*v)));
        }
        let goal_constant = frames.windows(2).all(|w| w[0].goal == w[1].goal);
        let goals = if goal_constant { &frames[..1] } else { &frames[..] };
        let floats = |values: &mut dyn Iterator<Item = f32>| {
            let mut bytes = Bytes::default();
            values.for_each(|v| bytes.f32(v));
            bytes.base64()
        };
        PageEpisode {
            name: &episode.name,
            task: &episode.setting.task,
            measure: &episode.setting.measure,
            threshold: episode.setting.threshold,
            goal_radius: episode.setting.goal_radius,
            scene: episode.setting.scene.iter().map(PageShape::from).collect(),
            frames: frames.len(),
            origin,
            step,
            time: floats(&mut frames.iter().map(|f| f.time)),
            distance: floats(&mut frames.iter().map(|f| f.distance)),
            goal: floats(&mut goals.iter().flat_map(|f| f.goal.unwrap_or([f32::NAN; 3]))),
            links: links.base64(),
            status: status.base64(),
            torque: torque.base64(),
            attention: attention.base64(),
            moving: moving.base64(),
            events: &episode.events,
            summary: &episode.summary,
        }
    }
}

impl Setting {
    fn check(&self) -> Result<(), String> {
        for (what, size) in [("goal's radius", self.goal_radius), ("threshold", self.threshold)] {
            if !size.is_finite() || size < 0.0 {
                return Err(format!("has a {what} of {size}; it must be zero or more"));
            }
        }
        match self.scene.iter().find(|s| !s.pose.is_finite()) {
            Some(shape) => Err(format!("has a shape in its scene whose pose is not finite: {shape:?}")),
            None => Ok(()),
        }
    }
}

impl FrameRecord {
    fn check(&self, robot: &Robot, moving: usize) -> Result<(), String> {
        let links = robot.modules * robot.links_per_module;
        let counts = [
            ("link poses", self.links.len(), links),
            ("module states", self.status.len(), robot.modules),
            ("module torques", self.torques.len(), robot.modules),
            ("poses of moving shapes", self.moving.len(), moving),
            (
                "attention weights",
                self.attention.as_ref().map_or(robot.modules * robot.modules, Vec::len),
                robot.modules * robot.modules,
            ),
        ];
        for (what, got, want) in counts {
            if got != want {
                return Err(format!(
                    "has {got} {what}; a robot of {} modules with {} links needs {want}",
                    robot.modules, robot.links_per_module
                ));
            }
        }
        if !self.time.is_finite() {
            return Err(format!("is at time {}", self.time));
        }
        if let Some(link) = self.links.iter().position(|p| !p.is_finite()) {
            return Err(format!("has a pose that is not finite (link {link}): the simulation broke down"));
        }
        if self.moving.iter().any(|p| !p.is_finite()) || self.goal.is_some_and(|g| g.iter().any(|v| !v.is_finite())) {
            return Err("has a goal or a moving shape whose pose is not finite".into());
        }
        Ok(())
    }
}

/// What the page reads. Arrays are little-endian and in base64: `f32` for times, distances, goals (one, or one a frame) and
/// moving shapes; `i16` for links (position / step, rotation * 32767), `u8` for states and attention, `i8` for torques.
#[derive(Serialize)]
struct PageData<'a> {
    format: u32,
    title: &'a str,
    robot: &'a Robot,
    summary: &'a [(String, String)],
}

#[derive(Serialize)]
struct PageShape<'a> {
    kind: &'static str,
    size: [f32; 3],
    pose: Pose,
    look: Look,
    moves: bool,
    label: &'a str,
}

impl<'a> From<&'a Shape> for PageShape<'a> {
    fn from(shape: &'a Shape) -> Self {
        let (kind, size) = match shape.outline {
            Outline::Box { half } => ("box", half),
            Outline::Cylinder { radius, half_length } => ("cylinder", [half_length, radius, radius]),
            Outline::Tube { radius, half_length } => ("tube", [half_length, radius, radius]),
            Outline::Sphere { radius } => ("sphere", [radius; 3]),
        };
        PageShape { kind, size, pose: shape.pose, look: shape.look, moves: shape.moves, label: &shape.label }
    }
}

#[derive(Serialize)]
struct PageEpisode<'a> {
    name: &'a str,
    task: &'a str,
    measure: &'a str,
    threshold: f32,
    goal_radius: f32,
    scene: Vec<PageShape<'a>>,
    frames: usize,
    origin: [f32; 3],
    step: f32,
    time: String,
    distance: String,
    goal: String,
    links: String,
    status: String,
    torque: String,
    attention: String,
    moving: String,
    events: &'a [Event],
    summary: &'a [(String, String)],
}

#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn i16(&mut self, value: f32) {
        self.0.extend((value.round() as i16).to_le_bytes());
    }

    fn f32(&mut self, value: f32) {
        self.0.extend(value.to_le_bytes());
    }

    /// RFC 4648 with padding, as the browser's `atob` reads it.
    fn base64(&self) -> String {
        const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        let mut text = String::with_capacity(self.0.len().div_ceil(3) * 4);
        for chunk in self.0.chunks(3) {
            let byte = |i: usize| u32::from(*chunk.get(i).unwrap_or(&0));
            let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
            for i in 0..4 {
                let digit = ALPHABET[(bits >> (18 - 6 * i) & 63) as usize];
                text.push(if i <= chunk.len() { char::from(digit) } else { '=' });
            }
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot(modules: usize) -> Robot {
        Robot {
            modules,
            links_per_module: 4,
            link_length: 0.5,
            link_radius: 0.4,
            torque_limit: 80.0,
            metres_per_unit: 0.05,
        }
    }

    fn frame(modules: usize, time: f32) -> FrameRecord {
        let wave = |i: usize| (time * 3.0 + i as f32).sin();
        FrameRecord {
            time,
            links: (0..modules * 4).map(|i| Pose::at([-0.5 * i as f32, wave(i), 0.4])).collect(),
            status: vec![Status::Ok; modules],
            torques: (0..modules).map(|i| [80.0 * wave(i), -200.0]).collect(),
            goal: Some([10.0, 3.0, 0.4]),
            distance: 10.0 - time,
            attention: Some((0..modules * modules).map(|i| (i * 37 % 251) as u8).collect()),
            moving: vec![],
        }
    }

    fn recording(modules: usize, frames: usize) -> Recording {
        let mut recording = Recording::new("a <title> & more", robot(modules));
        let mut episode = Episode::new("seed 1", Setting { goal_radius: 1.0, threshold: 1.0, ..Setting::default() });
        (0..frames).for_each(|i| episode.push(frame(modules, i as f32 * 0.05)));
        episode.event(0.1, "module 3 </script><!-- unplugged");
        recording.push(episode);
        recording
    }

    fn data(html: &str) -> serde_json::Value {
        let start = html.find("id=\"recording\">").expect("data element") + "id=\"recording\">".len();
        let end = start + html[start..].find("</script>").expect("end of the data");
        serde_json::from_str(&html[start..end]).expect("valid JSON")
    }

    fn unbase64(text: &str) -> Vec<u8> {
        let digit = |c: u8| match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            _ => 63,
        };
        let (mut out, mut bits, mut count) = (Vec::new(), 0u32, 0);
        for c in text.bytes().filter(|c| *c != b'=') {
            bits = bits << 6 | u32::from(digit(c));
            count += 6;
            if count >= 8 {
                count -= 8;
                out.push((bits >> count) as u8);
            }
        }
        out
    }

    #[test]
    fn base64_is_that_of_rfc_4648() {
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(Bytes(plain.as_bytes().to_vec()).base64(), coded);
        }
        assert_eq!(Bytes(vec![0xfb, 0xff, 0xfe]).base64(), "+//+");
    }

    #[test]
    fn what_is_recorded_is_in_the_page() {
        let html = recording(8, 3).to_html().unwrap();
        assert!(html.contains("<title>a &lt;title> &amp; more</title>"));
        let data = data(&html);
        assert_eq!(data["title"], "a <title> & more");
        let episode = &data["episodes"][0];
        assert_eq!(episode["frames"], 3);
        assert_eq!(episode["events"][0]["text"], "module 3 </script><!-- unplugged");
        let links = unbase64(episode["links"].as_str().unwrap());
        assert_eq!(links.len(), 3 * 32 * 14);
        let i16_at = |i: usize| f32::from(i16::from_le_bytes([links[2 * i], links[2 * i + 1]]));
        let step = episode["step"].as_f64().unwrap() as f32;
        let original = frame(8, 0.1);
        for (link, pose) in original.links.iter().enumerate() {
            for axis in 0..3 {
                let origin = episode["origin"][axis].as_f64().unwrap() as f32;
                let got = i16_at((2 * 32 + link) * 7 + axis) * step + origin;
                assert!((got - pose.position[axis]).abs() < 0.001, "link {link} axis {axis}: {got}");
            }
            assert_eq!(i16_at((2 * 32 + link) * 7 + 6), 32767.0);
        }
        // Torques beyond the limit saturate; the goal does not move and is stored once.
        assert_eq!(unbase64(episode["torque"].as_str().unwrap())[1] as i8, -127);
        assert_eq!(unbase64(episode["goal"].as_str().unwrap()).len(), 12);
        assert_eq!(unbase64(episode["attention"].as_str().unwrap())[..64], original.attention.unwrap()[..]);
    }

    #[test]
    fn an_episode_of_125_steps_stays_small_and_64_modules_fit() {
        let size = recording(8, 125).to_html().unwrap().len();
        assert!(size < 250_000, "{size} bytes");
        let size = recording(64, 125).to_html().unwrap().len();
        assert!(size < 2_000_000, "{size} bytes");
    }

    #[test]
    fn a_wide_recording_is_still_within_i16() {
        let mut recording = recording(8, 1);
        recording.episodes[0].frames[0].links[0].position = [500.0, 0.0, 0.0];
        let data = data(&recording.to_html().unwrap());
        let links = unbase64(data["episodes"][0]["links"].as_str().unwrap());
        let x = f32::from(i16::from_le_bytes([links[0], links[1]]));
        let got = x * data["episodes"][0]["step"].as_f64().unwrap() as f32
            + data["episodes"][0]["origin"][0].as_f64().unwrap() as f32;
        assert!((got - 500.0).abs() < 0.02, "{got}");
    }

    #[test]
    fn frames_that_do_not_fit_are_named() {
        type Spoil = fn(&mut FrameRecord);
        let cases: [(Spoil, &str); 5] = [
            (|f| f.links.truncate(30), "has 30 link poses"),
            (|f| f.status.clear(), "has 0 module states"),
            (|f| f.attention = Some(vec![0; 63]), "has 63 attention weights"),
            (|f| f.links[5].position[2] = f32::NAN, "not finite (link 5)"),
            (|f| f.time = 0.05, "not later than the frame before"),
        ];
        for (spoil, words) in cases {
            let mut recording = recording(8, 3);
            spoil(&mut recording.episodes[0].frames[2]);
            let message = recording.to_html().unwrap_err().to_string();
            assert!(message.contains("frame 2 of episode \"seed 1\"") && message.contains(words), "{message}");
        }
        let mut recording = recording(8, 3);
        recording.episodes[0].setting.goal_radius = -1.0;
        let message = recording.to_html().unwrap_err().to_string();
        assert!(message.contains("episode \"seed 1\" has a goal's radius of -1; it must be zero or more"), "{message}");
        let empty = Recording::new("t", robot(8));
        assert!(empty.to_html().unwrap_err().to_string().contains("no episode"));
    }

    #[test]
    fn the_file_is_complete_or_absent() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("replay.html");
        recording(2, 2).write_html(&path).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), recording(2, 2).to_html().unwrap());
        // Overwrites, and leaves nothing else behind.
        recording(2, 3).write_html(&path).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        let missing = folder.path().join("none/replay.html");
        let message = recording(2, 2).write_html(&missing).unwrap_err().to_string();
        assert!(message.contains("make the folder") && message.contains("none"), "{message}");
        let message = recording(2, 2).write_html(folder.path()).unwrap_err().to_string();
        assert!(message.contains("it is a folder"), "{message}");
        let message = recording(2, 2).write_html(&path.join("x.html")).unwrap_err().to_string();
        assert!(message.contains("is not a folder"), "{message}");
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn a_folder_that_cannot_be_written_is_named() {
        // No user, not even root, can make a file there.
        let message = recording(2, 2).write_html(Path::new("/proc/replay.html")).unwrap_err().to_string();
        assert!(message.contains("choose a folder that is writable") && message.contains("/proc is not"), "{message}");
    }
}
