//! Episodes on the bus as [MCAP](https://mcap.dev) files, for Foxglove, Rerun and other programs.
//!
//! | topic | schema | when | what |
//! |---|---|---|---|
//! | `/tf` | `foxglove.FrameTransforms` | every control cycle | where the links `link_0` to the last, `block` and `goal` are in the `world`, robot units |
//! | `/scene` | `foxglove.SceneUpdate` | at the start, and when what a module is able to do changes | the snake, coloured by that, and what stands on the ground |
//! | `/bus` | `composer.Frame`, JSON | every frame on the wire | piece of cable, identifier, name, sender, FD and bit-rate switch, payload |
//! | `/joints` | `composer.Joints`, JSON | every control cycle | angles by the module's sensors, rad, and speeds, rad/s, module by module |
//! | `/torques` | `composer.Torques`, JSON | every control cycle | what the plant applies, yaw and pitch, module by module |
//! | `/attention` | `composer.Attention`, JSON | every control cycle | weights of each module's last action over all modules, 0 to 1 |
//! | `/modules` | `composer.Modules`, JSON | every control cycle | what each module is at: plugged, mode, time-keeper, whom it believes alive, its faults, its error state on the bus |
//! | `/faults` | `composer.Faults`, JSON | when they change | what is wrong, in words |
//!
//! Times are the robot's. Episodes follow one another, each from a whole second on.

mod protobuf;
mod writer;

use std::fs::File;
use std::io;

use composer_shared::wire::Frame;
use composer_sim_bridge::Plant;
use composer_sim_bridge::confinement::ErrorState;
use composer_sim_bridge::faults::Fault;
use composer_sim_bridge::sil::CycleView;
use serde_json::{Value, json};

use self::protobuf::{Encoder, descriptors, timestamp};
use self::writer::Writer;
use crate::recorder::{describe, module_status, setting};
use crate::replay::{Look, Outline, Pose, Shape, Status};
use crate::sil::SnakePlant;

const SECOND: u64 = 1_000_000_000;

/// Channels, in the order in which they are made.
#[derive(Clone, Copy)]
enum Topic {
    Transforms,
    Scene,
    Bus,
    Joints,
    Torques,
    Attention,
    Modules,
    Faults,
}

/// JSON schemas of the topics that have no schema of Foxglove's.
fn schemas() -> [(&'static str, &'static str, Value); 6] {
    let numbers = json!({"type": "array", "items": {"type": "number"}});
    let table = json!({"type": "array", "items": numbers});
    let object = |properties: Value| json!({"type": "object", "properties": properties});
    let integer = || json!({"type": "integer"});
    let texts = json!({"type": "array", "items": {"type": "string"}});
    let module = object(json!({
        "plugged": {"type": "boolean"}, "mode": {"type": "string"}, "cycle": integer(), "time_keeper": {"type": ["integer", "null"]},
        "alive": {"type": "array", "items": integer()}, "faults": texts, "bus": {"type": "string"},
    }));
    [
        (
            "/bus",
            "composer.Frame",
            object(json!({
                "piece": integer(), "id": integer(), "name": {"type": "string"}, "sender": integer(), "fd": {"type": "boolean"},
                "brs": {"type": "boolean"}, "data": {"type": "string"},
            })),
        ),
        ("/joints", "composer.Joints", object(json!({"angles": table, "speeds": table}))),
        ("/torques", "composer.Torques", object(json!({"applied": table}))),
        ("/attention", "composer.Attention", object(json!({"weights": table}))),
        ("/modules", "composer.Modules", object(json!({"modules": {"type": "array", "items": module}}))),
        ("/faults", "composer.Faults", object(json!({"active": texts}))),
    ]
}

/// Writes episodes down.
pub struct Recording {
    writer: Writer,
    /// What a time of this episode is later in the file, ns.
    from_ns: u64,
    last_ns: u64,
    episodes: u64,
    /// What the scene and the faults were last.
    status: Vec<Status>,
    faults: Option<Vec<Fault>>,
    scene: Vec<Shape>,
}

impl Recording {
    /// Into a file that is empty.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub fn new(file: File) -> io::Result<Self> {
        let mut writer = Writer::new(file, concat!("composer ", env!("CARGO_PKG_VERSION")))?;
        let foxglove = descriptors();
        for (topic, schema) in [("/tf", "foxglove.FrameTransforms"), ("/scene", "foxglove.SceneUpdate")] {
            writer.channel(topic, schema, "protobuf", &foxglove, "protobuf");
        }
        for (topic, name, schema) in schemas() {
            writer.channel(topic, name, "jsonschema", schema.to_string().as_bytes(), "json");
        }
        Ok(Recording {
            writer,
            from_ns: 0,
            last_ns: 0,
            episodes: 0,
            status: Vec::new(),
            faults: None,
            scene: Vec::new(),
        })
    }

    /// An episode begins with the plant as it is.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub fn begin_episode(&mut self, plant: &SnakePlant) -> io::Result<()> {
        if self.episodes > 0 {
            self.from_ns = (self.last_ns + SECOND).next_multiple_of(SECOND);
        }
        self.episodes += 1;
        let (task, course, robot) = (&plant.config().task, plant.judge().course(), plant.snake().robot());
        self.scene = setting(task, course, robot.link_radius).scene;
        self.status = vec![Status::Ok; robot.modules];
        self.faults = None;
        self.last_ns = self.from_ns;
        self.transforms(plant)?;
        self.scene(plant)
    }

    /// A frame on the wire.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub fn frame(&mut self, at_ns: u64, piece: usize, frame: &Frame) -> io::Result<()> {
        self.last_ns = self.from_ns + at_ns;
        let data: String = frame.payload().iter().map(|byte| format!("{byte:02X}")).collect();
        let name = frame.function().map_or("unknown", |function| function.name());
        self.json(
            Topic::Bus,
            &json!({
                "piece": piece, "id": frame.id, "name": name, "sender": frame.module(), "fd": frame.fd, "brs": frame.brs, "data": data,
            }),
        )
    }

    /// The end of a control cycle.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub fn cycle(&mut self, view: &CycleView<'_>, plant: &SnakePlant) -> io::Result<()> {
        self.last_ns = self.from_ns + view.at_ns;
        self.transforms(plant)?;
        let count = view.modules.len();
        let status: Vec<Status> = (0..count).map(|m| module_status(m, &view.modules[m], view.faults)).collect();
        if self.status != status {
            self.status = status;
            self.scene(plant)?;
        }
        let sensors: Vec<_> = (0..count).map(|module| plant.sensors(module)).collect();
        let joints = json!({
            "angles": sensors.iter().map(|s| s.joint_angles).collect::<Vec<_>>(),
            "speeds": sensors.iter().map(|s| s.joint_speeds).collect::<Vec<_>>(),
        });
        self.json(Topic::Joints, &joints)?;
        let torques: Vec<_> = view.modules.iter().map(|module| module.torque).collect();
        self.json(Topic::Torques, &json!({"applied": torques}))?;
        let weights = view.modules.iter().map(|module| {
            let weight = |w: &u16| if module.plugged { f32::from(*w) / 32767.0 } else { 0.0 };
            module.attention[..count].iter().map(weight).collect::<Vec<_>>()
        });
        self.json(Topic::Attention, &json!({"weights": weights.collect::<Vec<_>>()}))?;
        let modules = view.modules.iter().map(|module| {
            json!({
                "plugged": module.plugged, "mode": module.mode.name(), "cycle": module.cycle, "time_keeper": module.time_keeper,
                "alive": (0..count).filter(|other| module.alive >> other & 1 == 1).collect::<Vec<_>>(),
                "faults": module.faults.iter().map(|fault| format!("{fault:?}")).collect::<Vec<_>>(),
                "bus": match module.bus {
                    ErrorState::Active => "error active",
                    ErrorState::Passive => "error passive",
                    ErrorState::BusOff => "bus off",
                },
            })
        });
        self.json(Topic::Modules, &json!({"modules": modules.collect::<Vec<_>>()}))?;
        if self.faults.as_deref() != Some(view.faults) {
            self.faults = Some(view.faults.to_vec());
            self.json(Topic::Faults, &json!({"active": view.faults.iter().map(describe).collect::<Vec<_>>()}))?;
        }
        Ok(())
    }

    /// All is written.
    ///
    /// # Errors
    ///
    /// If the end cannot be.
    pub fn finish(&mut self) -> io::Result<()> {
        self.writer.finish()
    }

    fn json(&mut self, topic: Topic, value: &Value) -> io::Result<()> {
        self.writer.message(topic as u16, self.last_ns, value.to_string().as_bytes())
    }

    /// Where everything is that moves.
    fn transforms(&mut self, plant: &SnakePlant) -> io::Result<()> {
        let pose = |(position, rotation)| Pose { position, rotation };
        let mut frames: Vec<(String, Pose)> =
            plant.snake().poses().map(pose).enumerate().map(|(link, pose)| (format!("link_{link}"), pose)).collect();
        frames.extend(plant.snake().block().map(|block| ("block".into(), pose(block))));
        frames.push(("goal".into(), Pose::at(plant.judge().course().goal)));
        let now = timestamp(self.last_ns);
        let transforms = frames.iter().fold(Encoder::default(), |all, (name, pose)| {
            let one = Encoder::default().message(1, &now).text(2, "world").text(3, name);
            let translation = Encoder::default().doubles(&pose.position);
            let one = one.message(4, &translation).message(5, &Encoder::default().doubles(&pose.rotation));
            all.message(1, &one)
        });
        self.writer.message(Topic::Transforms as u16, self.last_ns, &transforms.finish())
    }

    /// The snake, coloured by what its modules are able to do, and what stands on the ground.
    fn scene(&mut self, plant: &SnakePlant) -> io::Result<()> {
        let robot = plant.snake().robot();
        let now = timestamp(self.last_ns);
        let everything = Encoder::default().message(1, &now).number(2, 1);
        let mut update = Encoder::default().message(1, &everything);
        let entity =
            |id: &str, frame: &str| Encoder::default().message(1, &now).text(2, frame).text(3, id).number(5, 1);
        let (length, radius) = (robot.link_length, robot.link_radius);
        for link in 0..robot.modules * robot.links_per_module {
            let module = link / robot.links_per_module;
            let colour = colour_of(self.status[module], module);
            let frame = format!("link_{link}");
            // A cylinder of Foxglove's stands along z; a link lies along its own x.
            let along_x = [0.0, std::f32::consts::FRAC_1_SQRT_2, 0.0, std::f32::consts::FRAC_1_SQRT_2];
            let pose = pose_message(&Pose { position: [0.0; 3], rotation: along_x });
            let size = Encoder::default().doubles(&[2.0 * radius, 2.0 * radius, length]);
            let cylinder = Encoder::default().message(1, &pose).message(2, &size).double(3, 1.0).double(4, 1.0);
            update = update.message(2, &entity(&frame, &frame).message(10, &cylinder.message(5, &colour)));
        }
        for (number, shape) in self.scene.iter().enumerate() {
            let (frame, pose) = match shape.moves {
                true => ("block", Pose::at([0.0; 3])),
                false => ("world", shape.pose),
            };
            let colour = Encoder::default().doubles(&match shape.look {
                Look::Solid => [0.6, 0.55, 0.5, 1.0],
                Look::Glass => [0.5, 0.7, 0.9, 0.25],
                Look::Wanted => [0.2, 0.8, 0.3, 0.6],
            });
            let entity = entity(&format!("thing_{number}"), frame);
            update = update.message(2, &primitive(entity, shape.outline, &pose, &colour));
        }
        let goal = Outline::Sphere { radius: plant.config().task.rules().goal_radius().max(0.2) };
        let colour = Encoder::default().doubles(&[0.2, 0.8, 0.3, 0.4]);
        update = update.message(2, &primitive(entity("goal", "goal"), goal, &Pose::at([0.0; 3]), &colour));
        self.writer.message(Topic::Scene as u16, self.last_ns, &update.finish())
    }
}

fn pose_message(pose: &Pose) -> Encoder {
    let position = Encoder::default().doubles(&pose.position);
    Encoder::default().message(1, &position).message(2, &Encoder::default().doubles(&pose.rotation))
}

/// An entity with one thing in it.
fn primitive(entity: Encoder, outline: Outline, pose: &Pose, colour: &Encoder) -> Encoder {
    let sized = |size: [f32; 3], pose: &Pose| {
        Encoder::default().message(1, &pose_message(pose)).message(2, &Encoder::default().doubles(&size))
    };
    match outline {
        Outline::Box { half } => entity.message(8, &sized(half.map(|h| 2.0 * h), pose).message(3, colour)),
        Outline::Sphere { radius } => entity.message(9, &sized([2.0 * radius; 3], pose).message(3, colour)),
        // Along their own x axes.
        Outline::Cylinder { radius, half_length } | Outline::Tube { radius, half_length } => {
            let size = [2.0 * half_length, 2.0 * radius, 2.0 * radius];
            entity.message(8, &sized(size, pose).message(3, colour))
        }
    }
}

/// Neighbours in two shades; what is broken stands out.
fn colour_of(status: Status, module: usize) -> Encoder {
    let shade = if module.is_multiple_of(2) { 1.0 } else { 0.8 };
    let [r, g, b] = match status {
        Status::Ok => [0.2, 0.45, 0.9],
        Status::Unplugged => [0.35, 0.35, 0.35],
        Status::ActuatorDead => [0.9, 0.25, 0.2],
        Status::SensorFault => [0.95, 0.7, 0.1],
        Status::Relaxed => [0.7, 0.75, 0.8],
    };
    Encoder::default().doubles(&[shade * r, shade * g, shade * b, 1.0])
}
