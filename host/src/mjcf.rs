//! Robot and scene as MJCF, the model format of MuJoCo.
//!
//! Units and frames are the robot's own ([`crate::robot`]): lengths in robot units, masses in kg, torques in kg units^2 / s^2, angles in
//! rad; world frame: x and y horizontal, z up, the snake along x with its head towards +x, the centre of the head link at the origin, one link
//! radius up.
//!
//! Names: link `l` of module `m`, counted from the head, is the body `module{m}.link{l}`, with a geom and a site of the same name; the joint
//! behind it is `module{m}.joint{l}`; the head floats by the joint `root`. `ground`, `solid{i}` and `block` are the rest.
//!
//! Mass and inertia are given, not taken from the shapes. A joint has the spring and the damping of the robot's joint at rest's speeds; the brake
//! above the no-load speed has no counterpart in MJCF, nor have the motors' slew.
//!
//! MuJoCo's own contacts are usable, but another law than this program's: on the ground each capsule has a `<pair>` with the two
//! frictions along and across it, for there MuJoCo aligns the contact's frame with the capsule. Between a capsule and a box it does not, so
//! solids have the friction across in all directions, and the block has its own.

use std::fmt::Write;

use crate::robot::Robot;
use crate::sim::Scene;

/// Collision bits: one for the scene, the others shared by the modules in turn, as in [`crate::sim`].
const SHARED_BITS: usize = 30;
const SCENE_BIT: u32 = 1 << SHARED_BITS;
/// All bits that a positive 32-bit integer has.
const ALL_BITS: u32 = i32::MAX as u32;
/// MuJoCo wants torsional and rolling friction above zero even where the contact has none.
const NO_FRICTION: &str = "0.0001";

/// What is optional in a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// A motor on every joint, with the joint's name; its control is the torque.
    pub motors: bool,
}

/// The body, geom and site of a link.
pub fn link_name(robot: &Robot, link: usize) -> String {
    format!("module{}.link{}", link / robot.links_per_module, link % robot.links_per_module)
}

/// The joint between links `joint` and `joint + 1`. It belongs to the module of the link before it.
pub fn joint_name(robot: &Robot, joint: usize) -> String {
    format!("module{}.joint{}", joint / robot.links_per_module, joint % robot.links_per_module)
}

/// The model as XML.
pub fn mjcf(robot: &Robot, scene: &Scene, options: Options) -> String {
    let mut xml = String::with_capacity(600 * robot.links());
    // Writing to a string cannot fail.
    let _ = write_model(&mut xml, robot, scene, options);
    xml
}

fn write_model(out: &mut String, robot: &Robot, scene: &Scene, options: Options) -> std::fmt::Result {
    let (length, radius) = (robot.link_length, robot.link_radius);
    let (along, across) = (robot.friction_along, robot.friction_across);
    let [gx, gy, gz] = robot.gravity_vector();
    writeln!(out, "<mujoco model=\"{}\">", escaped(&robot.name))?;
    writeln!(
        out,
        "  <!-- Units: {} m, kg, s, rad; a torque of 1 is {} Nm. The head is at +x. -->",
        robot.scale.metres_per_unit, robot.scale.newton_metres_per_unit
    )?;
    writeln!(out, "  <compiler angle=\"radian\"/>")?;
    writeln!(
        out,
        "  <option timestep=\"{}\" gravity=\"{} {} {}\" integrator=\"implicitfast\" cone=\"elliptic\"/>",
        robot.physics_step, gx, gy, gz
    )?;
    writeln!(out, "  <default>")?;
    writeln!(out, "    <default class=\"link\">")?;
    writeln!(
        out,
        "      <geom type=\"capsule\" fromto=\"{half} 0 0 {} 0 0\" size=\"{radius}\" friction=\"{across} {NO_FRICTION} {NO_FRICTION}\" condim=\"3\"/>",
        -0.5 * length,
        half = 0.5 * length,
    )?;
    writeln!(
        out,
        "      <joint type=\"hinge\" pos=\"{} 0 0\" stiffness=\"{}\" damping=\"{}\"/>",
        0.5 * length,
        robot.stiffness,
        robot.joint_damping()
    )?;
    writeln!(out, "    </default>")?;
    writeln!(out, "    <default class=\"scene\">")?;
    writeln!(
        out,
        "      <geom friction=\"{across} {NO_FRICTION} {NO_FRICTION}\" condim=\"3\" contype=\"{SCENE_BIT}\" conaffinity=\"{ALL_BITS}\" rgba=\"0.6 0.6 0.55 1\"/>"
    )?;
    writeln!(out, "    </default>")?;
    writeln!(out, "  </default>")?;

    writeln!(out, "  <worldbody>")?;
    writeln!(out, "    <light pos=\"0 0 40\" directional=\"true\"/>")?;
    writeln!(out, "    <geom name=\"ground\" class=\"scene\" type=\"plane\" size=\"100 100 1\"/>")?;
    for (index, solid) in scene.solids.iter().enumerate() {
        writeln!(
            out,
            "    <geom name=\"solid{index}\" class=\"scene\" type=\"box\" size=\"{}\" pos=\"{}\" quat=\"{}\"/>",
            row(&solid.half),
            row(&solid.position),
            quaternion(solid.rotation())
        )?;
    }
    for link in 0..robot.links() {
        let module = link / robot.links_per_module;
        let name = link_name(robot, link);
        // A chain that were indented as it is nested would be mostly blanks.
        let indent = "    ";
        if link == 0 {
            writeln!(out, "{indent}<body name=\"{name}\" pos=\"0 0 {radius}\" childclass=\"link\">")?;
            writeln!(out, "{indent}  <freejoint name=\"root\"/>")?;
        } else {
            let joint = link - 1;
            let [x, y, z] = robot.joint_axis(joint);
            let axis = format!("{x} {y} {z}");
            writeln!(out, "{indent}<body name=\"{name}\" pos=\"{} 0 0\">", -length)?;
            writeln!(out, "{indent}  <joint name=\"{}\" axis=\"{axis}\"/>", joint_name(robot, joint))?;
        }
        writeln!(
            out,
            "{indent}  <inertial pos=\"0 0 0\" mass=\"{}\" diaginertia=\"{i} {i} {i}\"/>",
            robot.link_mass,
            i = robot.link_inertia
        )?;
        let (own, others) = collision_bits(module);
        let colour = if module.is_multiple_of(2) { "0.25 0.45 0.7 1" } else { "0.35 0.6 0.85 1" };
        writeln!(
            out,
            "{indent}  <geom name=\"{name}\" contype=\"{own}\" conaffinity=\"{others}\" rgba=\"{colour}\"/>"
        )?;
        writeln!(out, "{indent}  <site name=\"{name}\"/>")?;
    }
    writeln!(out, "    {}", "</body>".repeat(robot.links()))?;
    if let Some(block) = &scene.block {
        let turn = quaternion(block.rotation());
        writeln!(out, "    <body name=\"block\" pos=\"{}\" quat=\"{turn}\">", row(&block.position))?;
        writeln!(out, "      <freejoint name=\"block\"/>")?;
        writeln!(
            out,
            "      <inertial pos=\"0 0 0\" mass=\"{}\" diaginertia=\"{}\"/>",
            block.mass,
            row(&block.moments())
        )?;
        // By its priority the block's own friction counts, whatever the other side's.
        writeln!(
            out,
            "      <geom name=\"block\" class=\"scene\" type=\"box\" size=\"{}\" friction=\"{} {NO_FRICTION} {NO_FRICTION}\" priority=\"1\" rgba=\"0.8 0.5 0.2 1\"/>",
            row(&block.half),
            block.friction.max(1e-4)
        )?;
        writeln!(out, "    </body>")?;
    }
    writeln!(out, "  </worldbody>")?;

    writeln!(out, "  <contact>")?;
    for link in 0..robot.links() {
        writeln!(
            out,
            "    <pair geom1=\"ground\" geom2=\"{}\" condim=\"3\" friction=\"{along} {across} {NO_FRICTION} {NO_FRICTION} {NO_FRICTION}\"/>",
            link_name(robot, link)
        )?;
    }
    writeln!(out, "  </contact>")?;

    if options.motors {
        writeln!(out, "  <actuator>")?;
        for joint in 0..robot.links().saturating_sub(1) {
            let (name, limit) = (joint_name(robot, joint), robot.torque_limit);
            writeln!(
                out,
                "    <motor name=\"{name}\" joint=\"{name}\" ctrllimited=\"true\" ctrlrange=\"{} {limit}\"/>",
                -limit
            )?;
        }
        writeln!(out, "  </actuator>")?;
    }
    writeln!(out, "</mujoco>")
}

/// A module's own bit and those that it meets: the scene, and the modules that are not its neighbours (the capsules of neighbours overlap by
/// construction).
fn collision_bits(module: usize) -> (u32, u32) {
    let bit = |m: usize| 1u32 << (m % SHARED_BITS);
    let near = bit(module) | bit(module + 1) | bit(module + SHARED_BITS - 1);
    (bit(module), ALL_BITS & !near)
}

fn row(numbers: &[f32]) -> String {
    numbers.iter().map(f32::to_string).collect::<Vec<_>>().join(" ")
}

/// MuJoCo writes quaternions w first.
fn quaternion([x, y, z, w]: [f32; 4]) -> String {
    row(&[w, x, y, z])
}

/// Text in an attribute.
pub(crate) fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            // Not allowed in XML at all, or a line break that would be lost.
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::scene::{Block, Solid};

    /// Counts of the elements by name; panics unless every element is closed in order and every attribute quoted.
    fn elements(xml: &str) -> std::collections::BTreeMap<String, usize> {
        let (mut open, mut count) = (Vec::new(), std::collections::BTreeMap::new());
        let mut rest = xml;
        while let Some(at) = rest.find('<') {
            assert!(!rest[..at].contains('>'), "a stray > in {:?}", &rest[..at]);
            let end = at + rest[at..].find('>').expect("every tag ends");
            let tag = &rest[at + 1..end];
            rest = &rest[end + 1..];
            if tag.starts_with("!--") {
                assert!(tag.ends_with("--") && !tag[3..tag.len() - 2].contains("--"), "{tag}");
                continue;
            }
            if let Some(name) = tag.strip_prefix('/') {
                assert_eq!(open.pop().as_deref(), Some(name));
                continue;
            }
            let (body, closed) = tag.strip_suffix('/').map_or((tag, false), |body| (body, true));
            let name = body.split(' ').next().unwrap().to_string();
            let attributes = body[name.len()..].split('"').step_by(2);
            let quotes = body.matches('"').count();
            assert!(quotes.is_multiple_of(2), "{tag}");
            for before in attributes.take(quotes / 2) {
                let key = before.trim().strip_suffix('=').unwrap_or_else(|| panic!("no attribute in {tag}"));
                assert!(key.chars().all(|c| c.is_ascii_alphanumeric()), "{key} in {tag}");
            }
            *count.entry(name.clone()).or_insert(0) += 1;
            if !closed {
                open.push(name);
            }
        }
        assert!(open.is_empty(), "{open:?} is not closed");
        count
    }

    #[test]
    fn the_model_is_well_formed_and_complete() {
        let solid = Solid { half: [1.0, 0.5, 2.0], position: [8.0, 0.0, 2.0], yaw: 0.3, roll: 0.1 };
        let block = Block { half: [1.0, 1.0, 0.5], position: [3.0, 1.0, 0.5], yaw: 0.4, mass: 0.01, friction: 0.5 };
        let scene = Scene { solids: vec![solid, Solid { yaw: -0.2, ..solid }], block: Some(block) };
        for modules in [1, 8, 64] {
            let robot = Robot { name: "a <\"snake\"> & more".into(), modules, ..Robot::default() };
            let links = robot.links();
            for (scene, solids, blocks) in [(&scene, 2, 1), (&Scene::default(), 0, 0)] {
                let count = elements(&mjcf(&robot, scene, Options { motors: true }));
                assert_eq!(count["body"], links + blocks);
                assert_eq!(count["inertial"], links + blocks);
                assert_eq!(count["freejoint"], 1 + blocks);
                // One more of each in the defaults.
                assert_eq!(count["joint"], links);
                assert_eq!(count["geom"], links + 1 + solids + blocks + 2);
                assert_eq!(count["pair"], links);
                assert_eq!(count["motor"], links - 1);
                assert!(!elements(&mjcf(&robot, scene, Options::default())).contains_key("motor"));
            }
        }
    }

    #[test]
    fn a_link_meets_the_scene_and_modules_that_are_not_its_neighbours() {
        for module in 0..64 {
            let (own, others) = collision_bits(module);
            assert_eq!(others & SCENE_BIT, SCENE_BIT);
            assert_eq!(own & others, 0);
            for other in 0..64usize {
                let (theirs, they_meet) = collision_bits(other);
                // MuJoCo lets two geoms meet if either wants to; both want the same.
                assert_eq!(own & they_meet == 0, theirs & others == 0);
                let apart = module.abs_diff(other);
                if apart <= 1 {
                    assert_eq!(own & they_meet, 0, "{module} {other}");
                } else if apart < SHARED_BITS - 1 {
                    assert_ne!(own & they_meet, 0, "{module} {other}");
                }
            }
        }
    }
}
