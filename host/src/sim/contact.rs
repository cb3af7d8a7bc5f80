//! The law of contact: what pushes on a link that touches something, as a function of the velocities at the end of the step.
//!
//! Normal force (Hunt and Crossley 1975), with `x` the penetration and `v_n` the speed at which the two surfaces part:
//!
//! ```text
//! N = k max(0, x) max(0, 1 - h v_n)        k: contact_stiffness, force per unit;  h: contact_damping, s per unit
//! ```
//!
//! Friction is dry, anisotropic and of maximal dissipation (Moreau 1970; Goyal, Ruina and Papadopoulos 1991): of all forces inside the
//! ellipse with half-axes `mu_1 N` along the link and `mu_2 N` across it, the one that takes most power from the sliding velocity `(v_1, v_2)`:
//!
//! ```text
//! F_i = -N mu_i y_i / S,   y_i = mu_i v_i,   S = sqrt(y_1^2 + y_2^2 + eps^2),   eps = slip_speed min(mu_1, mu_2)
//! ```
//!
//! The only regularisation is the slip speed: a contact that holds creeps, at most at about that speed (units/s) where the force is 71 % of its
//! limit. It is a property of the robot's skin; neither step, nor mass, nor load changes it.
//!
//! A step of length `dt` sees `x = -gap - dt v_n` with the velocity at its end, so both forces are implicit: stable at any step, and a contact
//! cannot be missed by anything that comes nearer than the margin of the collision tests. In terms of the velocity both are the
//! gradient of a convex function, except that friction takes `N` as it is: [`Law::respond`] gives impulse and Hessian. With the load of the friction
//! held ([`Law::respond_held`]) nothing is excepted.

use rapier3d::glamx::glam::{Mat3A, Vec3A};

/// What a link touches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Other {
    /// The ground or a solid: it does not move.
    Fixed,
    /// Another link of the snake.
    Link(usize),
    /// The block.
    Block,
}

/// A place where a link, or a corner of the block, touches something or is about to.
#[derive(Clone, Copy, Debug)]
pub struct Contact {
    /// Which link it is; of no meaning for a corner of the block.
    pub link: usize,
    /// From the point that the link's twist is taken at to the contact, world axes, units.
    pub arm: Vec3A,
    /// What it touches.
    pub other: Other,
    /// The same from the other body's point.
    pub other_arm: Vec3A,
    /// From the other body to the link, length 1.
    pub normal: Vec3A,
    /// Tangent along the link.
    pub along: Vec3A,
    /// Tangent across the link.
    pub across: Vec3A,
    /// Distance of the surfaces, units; negative: how deep they are in each other.
    pub gap: f32,
    /// Coefficients of friction along and across.
    pub friction: [f32; 2],
    /// The normal impulse that friction goes by where it is held.
    pub held: f32,
}

impl Contact {
    /// Tangents for a contact with this normal of a link with this axis.
    pub fn tangents(normal: Vec3A, axis: Vec3A) -> (Vec3A, Vec3A) {
        let flat = axis - normal * axis.dot(normal);
        let length = flat.length();
        // A link that stands on its end has no direction along the surface: any pair will do.
        let along = if length > 1e-3 { flat / length } else { normal.any_orthonormal_vector() };
        (along, normal.cross(along))
    }
}

/// The numbers of the law, for one length of step.
#[derive(Clone, Copy, Debug)]
pub struct Law {
    /// Step, s.
    pub dt: f32,
    /// `k`, force per unit.
    pub stiffness: f32,
    /// `h`, s per unit.
    pub damping: f32,
    /// Slip speed, units/s.
    pub slip_speed: f32,
}

/// What a contact does in a step.
#[derive(Clone, Copy, Debug)]
pub struct Response {
    /// Impulse on the link.
    pub impulse: Vec3A,
    /// How it falls with the velocity: symmetric, positive semi-definite.
    pub hessian: Mat3A,
}

/// Friction of a contact under a load of one.
struct Sliding {
    /// Along and across.
    f: [f32; 2],
    /// `1 / S`.
    inverse: f32,
}

impl Sliding {
    #[inline(always)]
    fn new(contact: &Contact, velocity: Vec3A, slip_speed: f32) -> Self {
        let [mu1, mu2] = contact.friction;
        let (y1, y2) = (mu1 * contact.along.dot(velocity), mu2 * contact.across.dot(velocity));
        let eps = slip_speed * mu1.min(mu2);
        let inverse = 1.0 / (y1 * y1 + y2 * y2 + eps * eps).sqrt();
        Sliding { f: [mu1 * y1 * inverse, mu2 * y2 * inverse], inverse }
    }

    /// The Hessian of the contact with a normal one of `stiff`, and friction under a load.
    #[inline(always)]
    fn hessian(&self, contact: &Contact, stiff: f32, load: f32, curvature: f32) -> Mat3A {
        let ([mu1, mu2], [f1, f2]) = (contact.friction, self.f);
        let scale = load * self.inverse;
        let k11 = scale * (mu1 * mu1 - curvature * f1 * f1);
        let k12 = -scale * curvature * f1 * f2;
        let k22 = scale * (mu2 * mu2 - curvature * f2 * f2);
        let (n, a, b) = (contact.normal, contact.along, contact.across);
        let column = |j: usize| (stiff * n[j]) * n + (k11 * a[j] + k12 * b[j]) * a + (k12 * a[j] + k22 * b[j]) * b;
        Mat3A::from_cols(column(0), column(1), column(2))
    }
}

impl Law {
    /// The response to a velocity of the link relative to the other body at the contact. `curvature` from 0 to 1 is the share of the
    /// friction's curvature in the Hessian: 1 is its derivative, 0 an upper bound of it, with which Newton's steps never overshoot.
    #[inline(always)]
    pub fn respond(&self, contact: &Contact, velocity: Vec3A, curvature: f32) -> Option<Response> {
        let (deep, damped) = self.pressed(contact, velocity);
        if deep <= 0.0 || damped <= 0.0 {
            return None;
        }
        let normal = self.dt * self.stiffness * deep * damped;
        let stiff = self.stiff(deep, damped);
        let friction = Sliding::new(contact, velocity, self.slip_speed);
        let impulse = normal * (contact.normal - friction.f[0] * contact.along - friction.f[1] * contact.across);
        Some(Response { impulse, hessian: friction.hessian(contact, stiff, normal, curvature) })
    }

    /// Normal impulse at a velocity.
    pub fn load(&self, contact: &Contact, velocity: Vec3A) -> f32 {
        let (deep, damped) = self.pressed(contact, velocity);
        self.dt * self.stiffness * deep.max(0.0) * damped.max(0.0)
    }

    /// How deep the bodies are in each other at the end of the step, units, and by what damping multiplies the spring; either may be negative.
    #[inline(always)]
    fn pressed(&self, contact: &Contact, velocity: Vec3A) -> (f32, f32) {
        let parting = contact.normal.dot(velocity);
        (-contact.gap - self.dt * parting, 1.0 - self.damping * parting)
    }

    /// How the normal impulse falls with the speed of parting.
    #[inline(always)]
    fn stiff(&self, deep: f32, damped: f32) -> f32 {
        self.dt * self.stiffness * (self.dt * damped + self.damping * deep)
    }

    /// As [`Law::respond`], but friction goes by the load that the contact holds, whatever the velocity: impulse and Hessian are those of a convex function.
    pub fn respond_held(&self, contact: &Contact, velocity: Vec3A, curvature: f32) -> Option<Response> {
        let (deep, damped) = self.pressed(contact, velocity);
        let pressed = deep > 0.0 && damped > 0.0;
        if !pressed && contact.held == 0.0 {
            return None;
        }
        let (normal, stiff) =
            if pressed { (self.dt * self.stiffness * deep * damped, self.stiff(deep, damped)) } else { (0.0, 0.0) };
        let friction = Sliding::new(contact, velocity, self.slip_speed);
        let held = contact.held * (friction.f[0] * contact.along + friction.f[1] * contact.across);
        let hessian = friction.hessian(contact, stiff, contact.held, curvature);
        Some(Response { impulse: normal * contact.normal - held, hessian })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAW: Law = Law { dt: 0.01, stiffness: 2000.0, damping: 5.0, slip_speed: 0.05 };

    fn contact(gap: f32) -> Contact {
        let (along, across) = Contact::tangents(Vec3A::Z, Vec3A::new(0.6, 0.8, 0.3));
        Contact {
            link: 0,
            arm: Vec3A::ZERO,
            other: Other::Fixed,
            other_arm: Vec3A::ZERO,
            normal: Vec3A::Z,
            along,
            across,
            gap,
            friction: [0.1, 1.0],
            held: 0.0,
        }
    }

    fn force(velocity: Vec3A) -> Vec3A {
        LAW.respond(&contact(-0.01), velocity, 1.0).unwrap().impulse / LAW.dt
    }

    #[test]
    fn friction_lies_on_the_ellipse_and_takes_the_most_power() {
        let c = contact(-0.01);
        for (v1, v2) in [(3.0f32, 0.0f32), (0.0, 3.0), (2.0, 1.0), (5.0, -0.2), (-1.0, 1.0)] {
            let f = force(v1 * c.along + v2 * c.across);
            let load = f.dot(c.normal);
            let (f1, f2) = (f.dot(c.along), f.dot(c.across));
            let on_ellipse = (f1 / (0.1 * load)).hypot(f2 / load);
            assert!((on_ellipse - 1.0).abs() < 0.01, "{v1} {v2}: {on_ellipse}");
            let power = f1 * v1 + f2 * v2;
            for k in 0..360 {
                let (sin, cos) = (k as f32).to_radians().sin_cos();
                assert!(0.1 * load * cos * v1 + load * sin * v2 >= power - 1e-3 * load, "{v1} {v2} at {k}");
            }
        }
    }

    #[test]
    fn a_sliding_contact_feels_its_load_whatever_the_step() {
        let slow = Law { dt: 1e-4, ..LAW };
        let velocity = Vec3A::new(0.3, 0.0, 0.0);
        let (a, b) = (LAW.respond(&contact(-0.01), velocity, 1.0), slow.respond(&contact(-0.01), velocity, 1.0));
        let (a, b) = (a.unwrap().impulse / LAW.dt, b.unwrap().impulse / slow.dt);
        assert!((a - b).length() < 1e-4 * a.length(), "{a} {b}");
    }

    #[test]
    fn the_hessian_is_the_slope_of_the_impulse_at_constant_load() {
        let c = contact(-0.02);
        for velocity in [Vec3A::new(0.2, -0.1, 0.02), Vec3A::new(2.0, 1.0, -0.3), Vec3A::new(0.001, 0.0005, 0.0)] {
            let at = |v: Vec3A| LAW.respond(&c, v, 1.0).unwrap();
            let response = at(velocity);
            for axis in [c.along, c.across, c.normal] {
                let h = 1e-3 * velocity.length();
                let slope = (at(velocity - h * axis).impulse - at(velocity + h * axis).impulse) / (2.0 * h);
                // Friction's dependence on the load is left out of the Hessian, which stays symmetric.
                let compared = if axis == c.normal { c.normal } else { axis };
                let (found, expected) = ((response.hessian * axis).dot(compared), slope.dot(compared));
                assert!(
                    (found - expected).abs() < 2e-2 * expected.abs() + 1e-3,
                    "{velocity} {axis}: {found} {expected}"
                );
            }
        }
    }

    #[test]
    fn with_the_load_held_the_hessian_is_the_slope_of_the_whole_impulse() {
        let c = contact(-0.02);
        for velocity in [Vec3A::new(0.2, -0.1, 0.02), Vec3A::new(2.0, 1.0, -0.3), Vec3A::new(0.3, 0.1, 5.0)] {
            let held = Contact { held: 0.7 * LAW.load(&contact(-0.02), Vec3A::ZERO), ..c };
            let at = |v: Vec3A| LAW.respond_held(&held, v, 1.0).unwrap();
            for direction in [c.along, c.across, c.normal] {
                let h = 1e-3 * velocity.length();
                let slope = (at(velocity - h * direction).impulse - at(velocity + h * direction).impulse) / (2.0 * h);
                let found = at(velocity).hessian * direction;
                assert!(
                    (found - slope).length() < 2e-2 * slope.length() + 1e-3,
                    "{velocity} {direction}: {found} {slope}"
                );
            }
            // With the load that the contact has at this velocity it is the law itself.
            let own = Contact { held: LAW.load(&c, velocity), ..c };
            match (LAW.respond(&c, velocity, 0.8), LAW.respond_held(&own, velocity, 0.8)) {
                (Some(a), Some(b)) => {
                    assert!((a.impulse - b.impulse).length() < 1e-6 * a.impulse.length());
                    assert_eq!(a.hessian, b.hessian);
                }
                (a, b) => assert!(a.is_none() && b.is_none()),
            }
        }
    }

    #[test]
    fn what_parts_is_not_held_back() {
        assert!(LAW.respond(&contact(-0.01), Vec3A::new(0.0, 0.0, 0.3), 1.0).is_none());
        assert!(LAW.respond(&contact(0.01), Vec3A::ZERO, 1.0).is_none());
        // What comes near fast enough to arrive within the step is met.
        assert!(LAW.respond(&contact(0.01), Vec3A::new(0.0, 0.0, -1.5), 1.0).is_some());
    }
}
