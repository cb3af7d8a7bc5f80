//! Kinematics along the chain: where the head is, seen from a module.
//!
//! Every link has a frame at its centre: x towards the head, y to the left, z up at rest. A joint angle is the rotation of the
//! link behind the joint (towards the tail) relative to the link before it, right-handed about z (yaw) or y (pitch).
//! Every module publishes its joint angles, so each can lay the chain out for itself; no global position is needed.

use nalgebra::{Matrix3, Vector3};

use crate::math;
use crate::robot::{DEAD_AFTER, Geometry, MAX_JOINTS, ROOM};

/// A rotation and a translation: `point_in_a = rotation * point_in_b + position`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Where the origin of frame b is, in frame a (robot units).
    pub position: Vector3<f32>,
    /// The axes of frame b as columns, in frame a.
    pub rotation: Matrix3<f32>,
}

impl Pose {
    /// No rotation, no translation.
    pub fn identity() -> Self {
        Pose { position: Vector3::zeros(), rotation: Matrix3::identity() }
    }

    /// A point given in frame b, expressed in frame a.
    pub fn point(&self, p: Vector3<f32>) -> Vector3<f32> {
        self.rotation * p + self.position
    }

    /// The same relation seen from the other side.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Pose { position: -(rotation * self.position), rotation }
    }
}

/// What a module believes of the shape of the whole chain: the joint angles it last heard from each module.
///
/// A module that stays silent is assumed to have gone slack: without torque its joints relax towards straight with the time constant
/// of spring and damper ([`Chain::miss`]), which is closer to the truth than either its last angles or zero at once.
#[derive(Clone, Debug)]
pub struct Chain {
    geometry: Geometry,
    angles: [[f32; MAX_JOINTS]; ROOM],
    silent: [u8; ROOM],
}

impl Chain {
    /// A straight chain.
    pub fn new(geometry: Geometry) -> Self {
        Chain { geometry, angles: [[0.0; MAX_JOINTS]; ROOM], silent: [0; ROOM] }
    }

    /// Takes the joint angles (rad) that `module` published. Values that are not finite, and modules that cannot be, are ignored.
    pub fn hear(&mut self, module: usize, angles: &[f32; MAX_JOINTS]) {
        if let Some(slot) = self.angles.get_mut(module)
            && angles.iter().all(|a| a.is_finite())
        {
            *slot = *angles;
            self.silent[module] = 0;
        }
    }

    /// Nothing came from `module` in this control cycle. Its last angles hold for [`DEAD_AFTER`] cycles; from then on they
    /// relax by `factor` a cycle (0 to 1, `exp(-period / time constant)` of the joint's spring and damper).
    pub fn miss(&mut self, module: usize, factor: f32) {
        if let (Some(angles), Some(silent)) = (self.angles.get_mut(module), self.silent.get_mut(module)) {
            *silent = silent.saturating_add(1);
            if *silent >= DEAD_AFTER {
                angles.iter_mut().for_each(|angle| *angle *= factor);
            }
        }
    }

    /// The pose of the head link in `module`'s own frame. Cost: one rotation a joint between the head and the module.
    pub fn head_seen_from(&self, module: usize) -> Pose {
        let links = usize::from(self.geometry.links_per_module).clamp(1, MAX_JOINTS);
        let own = module * links + Geometry::OWN_LINK.min(links - 1);
        self.link_seen_from_head(own).inverse()
    }

    /// The pose of a link, counted from the head over all modules, in the frame of the head link.
    pub fn link_seen_from_head(&self, link: usize) -> Pose {
        let links = usize::from(self.geometry.links_per_module).clamp(1, MAX_JOINTS);
        let half = 0.5 * self.geometry.link_length;
        let mut pose = Pose::identity();
        let mut left = link;
        for module in &self.angles {
            for (k, &angle) in module.iter().take(links).enumerate() {
                if left == 0 {
                    return pose;
                }
                left -= 1;
                pose.position -= pose.rotation.column(0) * half;
                let (sin, cos) = math::sin_cos(angle);
                turn(&mut pose.rotation, k % 2, sin, cos);
                pose.position -= pose.rotation.column(0) * half;
            }
        }
        pose
    }
}

/// `rotation * R`, where R turns about z (axis 0, yaw) or y (axis 1, pitch).
#[inline(always)]
fn turn(rotation: &mut Matrix3<f32>, axis: usize, sin: f32, cos: f32) {
    let x = rotation.column(0).into_owned();
    if axis == 0 {
        let y = rotation.column(1).into_owned();
        rotation.set_column(0, &(x * cos + y * sin));
        rotation.set_column(1, &(y * cos - x * sin));
    } else {
        let z = rotation.column(2).into_owned();
        rotation.set_column(0, &(x * cos - z * sin));
        rotation.set_column(2, &(z * cos + x * sin));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f32::consts::FRAC_PI_2;

    /// Largest absolute element.
    fn largest<const R: usize, const C: usize>(m: nalgebra::SMatrix<f32, R, C>) -> f32 {
        m.iter().fold(0.0, |a, v| a.max(v.abs()))
    }

    #[test]
    fn a_straight_chain_has_its_head_straight_ahead() {
        let chain = Chain::new(Geometry::default());
        for module in 0..8 {
            let head = chain.head_seen_from(module);
            let expected = Vector3::new(0.5 * (4 * module + 1) as f32, 0.0, 0.0);
            assert!(largest(head.position - expected) < 1e-5, "{module}: {:?}", head.position);
            assert!(largest(head.rotation - Matrix3::identity()) < 1e-6);
        }
    }

    #[test]
    fn a_right_angle_in_yaw_puts_the_head_to_the_side() {
        let mut chain = Chain::new(Geometry::default());
        // The rear link turns left by 90 degrees about z, so its x axis points along the front link's y, and
        // the head, ahead in its own frame, lies to the right of the rear link.
        chain.hear(0, &[FRAC_PI_2, 0.0, 0.0, 0.0]);
        let head = chain.head_seen_from(0);
        assert!(largest(head.position - Vector3::new(0.25, -0.25, 0.0)) < 1e-5, "{:?}", head.position);
    }

    #[test]
    fn rotations_stay_orthonormal_over_the_longest_chain() {
        let mut chain = Chain::new(Geometry::default());
        for module in 0..ROOM {
            chain.hear(module, &[0.9, -0.8, 0.7, 0.6]);
        }
        let pose = chain.link_seen_from_head(4 * ROOM - 1);
        assert!(largest(pose.rotation.transpose() * pose.rotation - Matrix3::identity()) < 1e-3);
        let there_and_back = pose.inverse().point(pose.point(Vector3::new(1.0, 2.0, 3.0)));
        assert!(largest(there_and_back - Vector3::new(1.0, 2.0, 3.0)) < 1e-2);
    }

    #[test]
    fn silence_straightens_and_nonsense_is_ignored() {
        let mut chain = Chain::new(Geometry::default());
        chain.hear(2, &[1.0; 4]);
        chain.hear(2, &[f32::NAN; 4]);
        chain.hear(ROOM, &[1.0; 4]);
        for _ in 0..DEAD_AFTER - 1 {
            chain.miss(2, 0.5);
            assert_eq!(chain.angles[2], [1.0; 4]);
        }
        chain.miss(2, 0.5);
        chain.miss(ROOM, 0.5);
        assert_eq!(chain.angles[2], [0.5; 4]);
    }
}
