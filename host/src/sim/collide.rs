//! Where the snake touches, or is about to: analytic tests of its capsules against the ground, boxes and each other.
//!
//! A link is a capsule: a segment between the centres of its two end spheres (the joints) with a radius. Against a plane the two end spheres
//! are all there is. Against a box they are too, but for an edge that meets the segment between them: then the nearest point of the segment
//! is a third contact. Against another link it is the nearest pair of points. A box that can be pushed meets ground and solids with its
//! corners; its edges do not meet the edges of solids. A test compares the distances with rapier's (parry's).

use rapier3d::glamx::glam::{Mat3A, Quat, Vec3, Vec3A};
use rapier3d::parry::query::details::closest_points_segment_segment_with_locations_nD;
use rapier3d::parry::shape::SegmentPointLocation;

/// A box in the world.
#[derive(Clone, Copy, Debug)]
pub struct Cuboid {
    /// Half of each edge, units.
    pub half: Vec3A,
    /// Centre.
    pub centre: Vec3A,
    /// Its axes, as columns.
    pub axes: Mat3A,
}

/// Nearest points of a segment and something else.
#[derive(Clone, Copy, Debug)]
pub struct Near {
    /// On the segment, world.
    pub point: Vec3A,
    /// Away from the other, length 1.
    pub normal: Vec3A,
    /// Distance of the point from the other's surface, units; negative inside.
    pub distance: f32,
}

impl Cuboid {
    /// A box with these halves of its edges, centre and rotation.
    pub fn new(half: [f32; 3], centre: [f32; 3], [x, y, z, w]: [f32; 4]) -> Self {
        Cuboid {
            half: Vec3A::from(half),
            centre: Vec3A::from(centre),
            axes: Mat3A::from_quat(Quat::from_xyzw(x, y, z, w)),
        }
    }

    /// A point seen from the box.
    fn local(&self, point: Vec3A) -> Vec3A {
        let from = point - self.centre;
        Vec3A::new(self.axes.x_axis.dot(from), self.axes.y_axis.dot(from), self.axes.z_axis.dot(from))
    }

    /// Whether a ball reaches the box.
    pub fn within(&self, centre: Vec3A, radius: f32) -> bool {
        let outside = (self.local(centre).abs() - self.half).max(Vec3A::ZERO);
        outside.length_squared() < radius * radius
    }

    fn near(&self, local: Vec3A) -> Near {
        let clamped = local.clamp(-self.half, self.half);
        let away = local - clamped;
        let distance = away.length();
        let (normal, distance) = if distance > 1e-6 {
            (away / distance, distance)
        } else {
            // Inside: out by the nearest face.
            let depth = self.half - local.abs();
            let axis = if depth.x <= depth.y && depth.x <= depth.z {
                Vec3A::X
            } else if depth.y <= depth.z {
                Vec3A::Y
            } else {
                Vec3A::Z
            };
            (axis * local.dot(axis).signum(), -depth.dot(axis))
        };
        Near { point: self.axes * local + self.centre, normal: self.axes * normal, distance }
    }

    /// Nearest face, edge or corner to a point.
    pub fn near_point(&self, point: Vec3A) -> Near {
        self.near(self.local(point))
    }

    /// Where a segment is nearest to the box: both its ends, and the place between them if that is nearer than either.
    pub fn near_segment(&self, from: Vec3A, to: Vec3A, mut each: impl FnMut(Near)) {
        let (from, to) = (self.local(from), self.local(to));
        each(self.near(from));
        each(self.near(to));
        // The distance to a convex body is convex along the segment; its slope has the sign of this.
        let way = to - from;
        let slope = |t: f32| {
            let p = from + t * way;
            way.dot(p - p.clamp(-self.half, self.half))
        };
        let least = 1e-4 * way.length();
        if slope(0.0) < -least && slope(1.0) > least {
            let (mut low, mut high) = (0.0, 1.0);
            for _ in 0..16 {
                let middle = 0.5 * (low + high);
                if slope(middle) < 0.0 { low = middle } else { high = middle }
            }
            each(self.near(from + 0.5 * (low + high) * way));
        }
    }

    /// Its eight corners.
    pub fn corners(&self) -> impl Iterator<Item = Vec3A> + '_ {
        (0..8).map(|c| {
            let sign = |bit: u8| if c >> bit & 1 == 1 { 1.0 } else { -1.0 };
            self.centre + self.axes * (self.half * Vec3A::new(sign(0), sign(1), sign(2)))
        })
    }
}

/// Nearest points of two segments: on the first one, on the second one.
pub fn near_segments([a, b]: [Vec3A; 2], [c, d]: [Vec3A; 2]) -> (Vec3A, Vec3A) {
    let [a, b, c, d] = [a, b, c, d].map(Vec3::from);
    let (one, two) = closest_points_segment_segment_with_locations_nD((&a, &b), (&c, &d));
    let at = |[a, b]: [Vec3; 2], location: SegmentPointLocation| {
        let [s, t] = location.barycentric_coordinates();
        Vec3A::from(a * s + b * t)
    };
    (at([a, b], one), at([c, d], two))
}

#[cfg(test)]
mod tests {
    use rapier3d::math::{Pose, Rotation, Vector};
    use rapier3d::parry::query;
    use rapier3d::parry::shape::{Capsule, Cuboid as Shape};

    use super::*;

    struct Numbers(u64);

    impl Numbers {
        /// From -1 to 1.
        fn next(&mut self) -> f32 {
            self.0 = crate::methods::mix(self.0);
            (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        }

        fn vector(&mut self, scale: f32) -> Vec3A {
            scale * Vec3A::new(self.next(), self.next(), self.next())
        }
    }

    #[test]
    fn distances_from_a_box_are_those_of_rapier() {
        let mut numbers = Numbers(1);
        let (mut touched, mut between) = (0, 0);
        for _ in 0..2000 {
            let half = numbers.vector(1.0).abs() + 0.1;
            let axis = numbers.vector(1.0).normalize();
            let rotation = Quat::from_axis_angle(axis.into(), 3.0 * numbers.next());
            let (centre, from) = (numbers.vector(1.0), numbers.vector(2.0));
            let to = from + 0.5 * numbers.vector(1.0).normalize();
            let cuboid = Cuboid::new(half.to_array(), centre.to_array(), rotation.to_array());
            let mut found: Vec<Near> = Vec::new();
            cuboid.near_segment(from, to, |near| found.push(near));
            let least = found.iter().map(|n| n.distance).fold(f32::INFINITY, f32::min) - 0.4;
            let pose = Pose::from_parts(centre.into(), Rotation::from_array(rotation.to_array()));
            let capsule = Capsule::new(Vector::from(from), Vector::from(to), 0.4);
            let (a, b) = (Shape::new(half.into()), capsule);
            let contact = query::contact(&pose, &a, &Pose::IDENTITY, &b, 10.0).unwrap().unwrap();
            // Once the axis itself is in the box, ways out differ. Rapier's iteration stops a little short of the nearest point.
            if least > -0.39 {
                assert!(
                    (-6e-3..1e-3).contains(&(least - contact.dist)),
                    "{least} instead of {}: {found:?}",
                    contact.dist
                );
                touched += u32::from(least < 0.0);
                between += u32::from(found.len() == 3);
            }
        }
        assert!(touched > 100 && between > 100, "{touched} {between}");
    }

    #[test]
    fn a_point_inside_leaves_by_the_nearest_face() {
        let cuboid = Cuboid::new([1.0, 2.0, 3.0], [0.0; 3], [0.0, 0.0, 0.0, 1.0]);
        let near = cuboid.near_point(Vec3A::new(-0.9, 0.0, 0.0));
        assert!((near.distance + 0.1).abs() < 1e-6 && near.normal == Vec3A::NEG_X);
    }
}
