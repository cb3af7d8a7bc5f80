//! The direct solver: a step of the whole chain, solved to convergence in coordinates in which joints cannot open.
//!
//! # What is solved
//!
//! The state is the pose of the head link, the joint angles `q`, the world twists of all links after the last step, and the block. A step of
//! length `dt` looks for the velocities at its end, `x = (head twist, dq/dt, block twist)`, at which all impulses balance (implicit Euler).
//! With every force the gradient of a potential of the velocity, that is the minimum of
//!
//! ```text
//! E(x) = sum over links  1/2 m |v_c - v_c,old - g dt|^2 + 1/2 I |w - w_old|^2
//!      + sum over joints dt (-tau qd + c/2 qd^2 + k q qd + k dt/2 qd^2)          spring, damping and torque, implicit
//!      + sum over contacts (see contact.rs; friction takes the normal force as it is)
//! ```
//!
//! Old twists are taken in the *world*, which brings the Coriolis terms; a link's inertia is the same about every axis, so there is no gyroscopic one.
//! What this converges to as `dt` falls is rigid-body dynamics with dry friction and compliant contacts, in first order.
//!
//! # How
//!
//! Newton's method. The Hessian of `E` is that of a tree, so a step of Newton is one sweep of Featherstone's articulated-body
//! algorithm, linear in the number of links. With a link's twist `(w, v)` taken at its front joint, `r` from there to its rear joint, `r_c = r/2` to its
//! centre, and a 6x6 block `H = [[A, B], [B^T, C]]` (moment and force over `w` and `v`):
//!
//! 1. Each link: inertia (`C = m`, `B = m [r_c]`, `A = I - m [r_c]^2`) and its contacts' Hessians, lifted by their arms.
//! 2. Tail to head, eliminating the hinge `s` of each link: `U = (A s, B^T s)`, `D = s.A s + d`, `u = joint gradient + s.n`; pass on `H - U U^T / D` and
//!    `p - U u / D`, moved from the rear to the front joint of the link before: `B <- B + [r] C`, `A <- A + [r] B^T - B_new [r]`, `n <- n + r x f`.
//! 3. The head: 6x6.
//! 4. Head to tail: `dqd = -(u + U . twist of the link before) / D`.
//!
//! Two things couple links outside the tree: the block, and contacts between links. Both ride along as further right-hand sides ("columns") of
//! the same sweep. The block brings six, `E`, its part of the Hessian with the links it touches; a contact between two links with Jacobian `J` and
//! Hessian `K` brings three, `J^T`, with its impulse `mu = K J step` as the unknown. With `T` the tree's Hessian and `p` the gradient,
//!
//! ```text
//! T step + E block + J^T mu = -p,   E^T step + H_b block = -p_b,   mu = K J step
//! ```
//!
//! and the sweep need only collect the products of all columns through `T^-1` to leave a small dense system for `(block, mu)`.
//! Contacts between links beyond the first [`SELF_CONTACTS`] are put into the tree as twice their own block on either link, an upper
//! bound: Newton's step falls short there rather than too far, and more sweeps make up for it.
//!
//! The iteration starts from the last velocities; the first sweeps take friction's Hessian without its curvature (an upper bound: full curvature
//! from the start diverges). If the slope at the end of a step exceeds half of that at its start, it went too far, and a short line search goes back.
//! It ends when `-gradient . step`, twice the energy still to be gained, is below `solver_tolerance` times `dt`.
//!
//! That friction takes the normal force as it is makes `E` no potential, and where friction is steep and what is pushed is light, Newton's steps can lead
//! away: the head that meets the edge of a block of a few grams, say. A step that does not end within `solver_iterations` sweeps is therefore begun again
//! with the load of every friction held, first at nothing: then `E` is convex, and Newton's method with its line search cannot fail. What the contacts
//! come to is halfway taken over as the load, and so on until it changes nothing any more (`HELD_ROUNDS` at most). Whatever load it ends with, such
//! friction only takes power, so that a step that does not converge is less exact but no source of energy.
//!
//! No fused multiply-add and no library trigonometry but `libm`'s, so that every processor computes the same bits.

#![expect(clippy::needless_range_loop, reason = "matrices are written with their indices, as in the formulas above")]

use rapier3d::glamx::glam::{Mat3A, Quat, Vec3A};

use super::State;
use super::collide::{self, Cuboid};
use super::contact::{Contact, Law, Other, Response};
use super::scene::Scene;
use crate::robot::Robot;

/// Sweeps without the curvature of friction, and its share after them.
const CAREFUL_SWEEPS: usize = 2;
const CURVATURE: f32 = 0.8;
/// Most other lengths of a step of Newton that are tried.
const TRIALS: usize = 4;
/// Most times that loads of friction which are held are taken over from the contacts, and how far each time.
const HELD_ROUNDS: usize = 40;
const TAKEN_OVER: f32 = 0.5;
/// Contacts between links whose coupling is exact.
pub const SELF_CONTACTS: usize = 8;
/// Most columns: three for each of them, six for the block.
const COLUMNS: usize = 3 * SELF_CONTACTS + 6;

/// Moment and force, or angular and linear velocity.
#[derive(Clone, Copy, Debug)]
struct Spatial {
    n: Vec3A,
    f: Vec3A,
}

impl Spatial {
    const ZERO: Spatial = Spatial { n: Vec3A::ZERO, f: Vec3A::ZERO };

    #[inline(always)]
    fn dot(self, other: Spatial) -> f32 {
        self.n.dot(other.n) + self.f.dot(other.f)
    }

    /// Angular or moment x, y, z, then linear or force x, y, z.
    fn component(self, k: usize) -> f32 {
        if k < 3 { self.n[k] } else { self.f[k - 3] }
    }

    #[inline(always)]
    fn add_scaled(&mut self, other: Spatial, scale: f32) {
        self.n += scale * other.n;
        self.f += scale * other.f;
    }

    /// A wrench about a point that lies `r` ahead of the one it was taken about, that is: from the rear joint to the front joint.
    #[inline(always)]
    fn wrench_moved(self, r: Vec3A) -> Self {
        Spatial { n: self.n + r.cross(self.f), f: self.f }
    }

    /// A twist at a point `r` away.
    #[inline(always)]
    fn twist_at(self, r: Vec3A) -> Self {
        Spatial { n: self.n, f: self.f + self.n.cross(r) }
    }
}

/// A symmetric 6x6 block `[[a, b], [b^T, c]]`.
#[derive(Clone, Copy, Debug)]
struct Block {
    a: Mat3A,
    b: Mat3A,
    c: Mat3A,
}

/// `[r] m`.
#[inline(always)]
fn cross_columns(r: Vec3A, m: Mat3A) -> Mat3A {
    Mat3A::from_cols(r.cross(m.x_axis), r.cross(m.y_axis), r.cross(m.z_axis))
}

/// `m - u v^T`.
#[inline(always)]
fn less_outer(m: Mat3A, u: Vec3A, v: Vec3A) -> Mat3A {
    Mat3A::from_cols(m.x_axis - u * v.x, m.y_axis - u * v.y, m.z_axis - u * v.z)
}

impl Block {
    const ZERO: Block = Block { a: Mat3A::ZERO, b: Mat3A::ZERO, c: Mat3A::ZERO };

    #[inline(always)]
    fn add(&mut self, other: &Block) {
        self.a += other.a;
        self.b += other.b;
        self.c += other.c;
    }

    /// Adds the Hessian `k` of something that depends on the velocity at `arm`.
    #[inline(always)]
    fn add_lifted(&mut self, k: Mat3A, arm: Vec3A) {
        let b = cross_columns(arm, k);
        self.a += cross_columns(arm, b.transpose());
        self.b += b;
        self.c += k;
    }

    /// The same block with twists taken at a point `r` behind: from the rear joint to the front joint.
    #[inline(always)]
    fn moved(&self, r: Vec3A) -> Block {
        let b = self.b + cross_columns(r, self.c);
        let one = cross_columns(r, self.b.transpose());
        let two = cross_columns(r, b.transpose());
        Block { a: self.a + one + two.transpose(), b, c: self.c }
    }

    /// Its 36 numbers, row by row.
    fn rows(&self) -> [[f32; 6]; 6] {
        let mut rows = [[0.0f32; 6]; 6];
        for j in 0..3 {
            for i in 0..3 {
                rows[i][j] = self.a.col(j)[i];
                rows[i][3 + j] = self.b.col(j)[i];
                rows[3 + j][i] = self.b.col(j)[i];
                rows[3 + i][3 + j] = self.c.col(j)[i];
            }
        }
        rows
    }

    /// Its factors `L D L^T`: `D` on the diagonal, `L` below it. The block is positive definite: every body has mass.
    fn factors(&self) -> [[f32; 6]; 6] {
        let mut l = self.rows();
        for j in 0..6 {
            for i in j + 1..6 {
                let factor = l[i][j] / l[j][j];
                for k in j + 1..=i {
                    l[i][k] -= factor * l[k][j];
                }
            }
            for i in j + 1..6 {
                l[i][j] /= l[j][j];
            }
        }
        l
    }
}

/// `x` with `L D L^T x = p`.
fn solve(l: &[[f32; 6]; 6], p: Spatial) -> Spatial {
    let mut x = [p.n.x, p.n.y, p.n.z, p.f.x, p.f.y, p.f.z];
    for i in 0..6 {
        for k in 0..i {
            x[i] -= l[i][k] * x[k];
        }
    }
    for i in (0..6).rev() {
        x[i] /= l[i][i];
        for k in i + 1..6 {
            x[i] -= l[k][i] * x[k];
        }
    }
    Spatial { n: Vec3A::new(x[0], x[1], x[2]), f: Vec3A::new(x[3], x[4], x[5]) }
}

/// What is kept of a link. Its twist is taken at its front joint.
#[derive(Clone, Copy, Debug)]
struct Link {
    /// Front joint, and the way to the rear one.
    anchor: Vec3A,
    r: Vec3A,
    /// Hinge to the link before, world.
    hinge: Vec3A,
    rotation: Quat,
    /// Twist in this iteration, and angular velocity and velocity of the centre after the last step.
    twist: Spatial,
    old: Spatial,
    /// Inertia at this place, and with the contacts.
    inertia: Block,
    hessian: Block,
    gradient: Spatial,
    step: Spatial,
}

/// The hinge between a link and the one before; entry 0 is not used.
#[derive(Clone, Copy, Debug, Default)]
struct Joint {
    angle: f32,
    speed: f32,
    torque: f32,
    damping: f32,
    /// Speed after the last step.
    old: f32,
    gradient: f32,
    /// What the sweep leaves for the way back.
    step: f32,
    inverse_d: f32,
    u: f32,
}

/// The block.
#[derive(Clone, Debug)]
struct Pushed {
    cuboid: Cuboid,
    rotation: Quat,
    mass: f32,
    /// Moments of inertia about its own axes.
    moments: Vec3A,
    friction: f32,
    twist: Spatial,
    /// Angular momentum and twist after the last step.
    momentum: Vec3A,
    old: Spatial,
    inertia: Mat3A,
    hessian: Block,
    gradient: Spatial,
    step: Spatial,
    /// Its corners' contacts.
    contacts: Vec<Contact>,
}

impl Pushed {
    fn turn(&mut self) {
        self.cuboid.axes = Mat3A::from_quat(self.rotation);
        let axes = self.cuboid.axes;
        let scaled =
            Mat3A::from_cols(axes.x_axis * self.moments.x, axes.y_axis * self.moments.y, axes.z_axis * self.moments.z);
        self.inertia = scaled * axes.transpose();
    }
}

/// A part of a column: a wrench on a link.
#[derive(Clone, Copy, Debug)]
struct Entry {
    link: usize,
    column: usize,
    wrench: Spatial,
}

/// What is coupled outside the tree, in one iteration.
#[derive(Clone, Debug)]
struct Couplings {
    /// Columns in use: first the block's, then the contacts'.
    count: usize,
    /// Whether the first six are the block's.
    block: bool,
    entries: Vec<Entry>,
    /// `K` of each coupled contact.
    hessians: Vec<Mat3A>,
    /// Of each joint, what the sweep leaves for the way back.
    left: Vec<[f32; COLUMNS]>,
    /// Products of the columns with each other and with the gradient through the inverse of the tree's Hessian.
    gram: [[f32; COLUMNS]; COLUMNS],
    against: [f32; COLUMNS],
    /// The unknowns.
    solution: [f32; COLUMNS],
}

impl Couplings {
    fn new(links: usize) -> Self {
        Couplings {
            count: 0,
            block: false,
            entries: Vec::new(),
            hessians: Vec::new(),
            left: vec![[0.0; COLUMNS]; links],
            gram: [[0.0; COLUMNS]; COLUMNS],
            against: [0.0; COLUMNS],
            solution: [0.0; COLUMNS],
        }
    }

    fn clear(&mut self) {
        self.count = 0;
        self.block = false;
        self.entries.clear();
        self.hessians.clear();
    }

    /// Solves for block and contacts, given the block's own Hessian and gradient.
    fn solve(&mut self, block: Option<(&Block, Spatial)>) {
        let n = self.count;
        let first = if self.block { 6 } else { 0 };
        let mut m = [[0.0f32; COLUMNS + 1]; COLUMNS];
        if let (true, Some((hessian, gradient))) = (self.block, block) {
            let own = hessian.rows();
            for i in 0..6 {
                for j in 0..n {
                    m[i][j] = if j < 6 { own[i][j] } else { 0.0 } - self.gram[i][j];
                }
                m[i][n] = self.against[i] - gradient.component(i);
            }
        }
        for (contact, k) in self.hessians.iter().enumerate() {
            let row = first + 3 * contact;
            for i in 0..3 {
                for j in 0..n {
                    m[row + i][j] = (0..3).map(|l| k.col(l)[i] * self.gram[row + l][j]).sum();
                }
                m[row + i][row + i] += 1.0;
                m[row + i][n] = -(0..3).map(|l| k.col(l)[i] * self.against[row + l]).sum::<f32>();
            }
        }
        // Gauss with pivots by row.
        for j in 0..n {
            let pivot = (j..n).fold(j, |best, i| if m[i][j].abs() > m[best][j].abs() { i } else { best });
            m.swap(j, pivot);
            let row = m[j];
            for other in m.iter_mut().take(n).skip(j + 1) {
                let factor = other[j] / row[j];
                for (a, b) in other[j..=n].iter_mut().zip(&row[j..=n]) {
                    *a -= factor * b;
                }
            }
        }
        for j in (0..n).rev() {
            let known: f32 = (j + 1..n).map(|k| m[j][k] * self.solution[k]).sum();
            self.solution[j] = (m[j][n] - known) / m[j][j];
        }
    }
}

/// What the solver did.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Effort {
    /// Steps taken.
    pub steps: u64,
    /// Sweeps in all of them.
    pub sweeps: u64,
    /// Steps that did not end within the cap of sweeps, and were taken again with the loads of friction held.
    pub held: u64,
    /// Of those, steps that did not end so either.
    pub capped: u64,
    /// Contacts found, in all steps.
    pub contacts: u64,
}

impl std::iter::Sum for Effort {
    fn sum<I: Iterator<Item = Effort>>(efforts: I) -> Effort {
        efforts.fold(Effort::default(), |a, b| Effort {
            steps: a.steps + b.steps,
            sweeps: a.sweeps + b.sweeps,
            held: a.held + b.held,
            capped: a.capped + b.capped,
            contacts: a.contacts + b.contacts,
        })
    }
}

/// The snake and its scene.
#[derive(Clone, Debug)]
pub struct Chain {
    links: Vec<Link>,
    joints: Vec<Joint>,
    /// Of each link, its hinge's part in `U` of the sweep.
    reach: Vec<Spatial>,
    couplings: Couplings,
    contacts: Vec<Contact>,
    solids: Vec<Cuboid>,
    block: Option<Pushed>,
    gravity: Vec3A,
    /// Whether the loads of friction are held in this step.
    held: bool,
    effort: Effort,
}

/// Velocity of a link at a contact against the other body's there.
#[inline(always)]
fn relative_velocity(links: &[Link], block: Option<&Pushed>, contact: &Contact) -> Vec3A {
    let velocity = links[contact.link].twist.twist_at(contact.arm).f;
    velocity
        - match contact.other {
            Other::Fixed => Vec3A::ZERO,
            Other::Link(other) => links[other].twist.twist_at(contact.other_arm).f,
            Other::Block => block.map_or(Vec3A::ZERO, |block| block.twist.twist_at(contact.other_arm).f),
        }
}

/// The rotation by a vector (axis times angle).
fn rotation_by(vector: Vec3A) -> Quat {
    let angle = vector.length();
    // sin(x/2)/x near 0.
    let (scale, cos) = if angle < 1e-4 {
        (0.5, 1.0)
    } else {
        let (sin, cos) = libm::sincosf(0.5 * angle);
        (sin / angle, cos)
    };
    Quat::from_xyzw(scale * vector.x, scale * vector.y, scale * vector.z, cos)
}

impl Chain {
    /// A straight snake at rest, its head link centred at the origin, in a scene.
    pub fn new(robot: &Robot, scene: &Scene) -> Self {
        let link = Link {
            anchor: Vec3A::ZERO,
            r: Vec3A::ZERO,
            hinge: Vec3A::ZERO,
            rotation: Quat::IDENTITY,
            twist: Spatial::ZERO,
            old: Spatial::ZERO,
            inertia: Block::ZERO,
            hessian: Block::ZERO,
            gradient: Spatial::ZERO,
            step: Spatial::ZERO,
        };
        let solids = scene.solids.iter().map(|s| Cuboid::new(s.half, s.position, s.rotation())).collect();
        let block = scene.block.map(|block| {
            let mut pushed = Pushed {
                cuboid: Cuboid::new(block.half, block.position, block.rotation()),
                rotation: Quat::from_array(block.rotation()),
                mass: block.mass,
                moments: Vec3A::from(block.moments()),
                friction: block.friction,
                twist: Spatial::ZERO,
                momentum: Vec3A::ZERO,
                old: Spatial::ZERO,
                inertia: Mat3A::ZERO,
                hessian: Block::ZERO,
                gradient: Spatial::ZERO,
                step: Spatial::ZERO,
                contacts: Vec::new(),
            };
            pushed.turn();
            pushed
        });
        let mut chain = Chain {
            links: vec![link; robot.links()],
            joints: vec![Joint::default(); robot.links()],
            reach: vec![Spatial::ZERO; robot.links()],
            couplings: Couplings::new(robot.links()),
            contacts: Vec::new(),
            solids,
            block,
            gravity: Vec3A::from(robot.gravity_vector()),
            held: false,
            effort: Effort::default(),
        };
        chain.links[0].anchor = Vec3A::new(0.5 * robot.link_length, 0.0, robot.link_radius);
        chain.place(robot);
        chain
    }

    /// What the solver did so far.
    pub fn effort(&self) -> Effort {
        self.effort
    }

    /// Forward kinematics: where everything is, from the head's pose and the joint angles.
    fn place(&mut self, robot: &Robot) {
        let (length, mass, moment) = (robot.link_length, robot.link_mass, robot.link_inertia);
        for i in 0..self.links.len() {
            if i > 0 {
                let front = self.links[i - 1];
                let axis = Vec3A::from(robot.joint_axis(i - 1));
                let (sin, cos) = libm::sincosf(0.5 * self.joints[i].angle);
                let turn = Quat::from_xyzw(0.0, sin * axis.y, sin * axis.z, cos);
                let link = &mut self.links[i];
                // One step of Newton keeps the quaternion at length 1.
                let rotation = front.rotation * turn;
                link.rotation = rotation * (1.5 - 0.5 * rotation.length_squared());
                link.anchor = front.anchor + front.r;
                link.hinge = front.rotation * axis;
            }
            let link = &mut self.links[i];
            link.r = link.rotation * Vec3A::new(-length, 0.0, 0.0);
            let centre = 0.5 * link.r;
            let diagonal = moment + mass * centre.length_squared();
            let square = |k: f32, unit: Vec3A| unit * diagonal - centre * (mass * k);
            link.inertia = Block {
                a: Mat3A::from_cols(square(centre.x, Vec3A::X), square(centre.y, Vec3A::Y), square(centre.z, Vec3A::Z)),
                b: mass * Mat3A::from_cols(centre.cross(Vec3A::X), centre.cross(Vec3A::Y), centre.cross(Vec3A::Z)),
                c: Mat3A::from_diagonal(rapier3d::glamx::glam::Vec3::splat(mass)),
            };
        }
    }

    fn centre(link: &Link) -> Vec3A {
        link.anchor + 0.5 * link.r
    }

    /// Finds the contacts of this place. Those of a link stand together, in order.
    fn find_contacts(&mut self, robot: &Robot) {
        let (radius, dt) = (robot.link_radius, robot.physics_step);
        let fastest = self.links.iter().map(|l| l.old.f.length_squared()).fold(0.0, f32::max).sqrt();
        // What may come within reach in a step, with room for what the step adds.
        let margin = 0.05 + 3.0 * dt * fastest;
        let friction = [robot.friction_along, robot.friction_across];
        self.contacts.clear();
        let half_length = 0.5 * robot.link_length;
        for (index, link) in self.links.iter().enumerate() {
            let (front, rear) = (link.anchor, link.anchor + link.r);
            let axis = link.r * (-1.0 / robot.link_length);
            let lowest = front.z.min(rear.z) - radius;
            if lowest < margin {
                let (along, across) = Contact::tangents(Vec3A::Z, axis);
                for point in [front, rear] {
                    let gap = point.z - radius;
                    if gap < margin {
                        self.contacts.push(Contact {
                            link: index,
                            arm: point - front - radius * Vec3A::Z,
                            other: Other::Fixed,
                            other_arm: Vec3A::ZERO,
                            normal: Vec3A::Z,
                            along,
                            across,
                            gap,
                            friction,
                            held: 0.0,
                        });
                    }
                }
            }
            let centre = Self::centre(link);
            let mut against = |cuboid: &Cuboid, other: Other| {
                if !cuboid.within(centre, half_length + radius + margin) {
                    return;
                }
                cuboid.near_segment(front, rear, |near| {
                    let gap = near.distance - radius;
                    if gap < margin {
                        let (along, across) = Contact::tangents(near.normal, axis);
                        let point = near.point - radius * near.normal;
                        self.contacts.push(Contact {
                            link: index,
                            arm: point - front,
                            other,
                            other_arm: point - cuboid.centre,
                            normal: near.normal,
                            along,
                            across,
                            gap,
                            friction,
                            held: 0.0,
                        });
                    }
                });
            };
            for solid in &self.solids {
                against(solid, Other::Fixed);
            }
            if let Some(block) = &self.block {
                against(&block.cuboid, Other::Block);
            }
        }
        self.find_self_contacts(robot, margin);
        self.effort.contacts += self.contacts.len() as u64;
        if let Some(block) = &mut self.block {
            block.contacts.clear();
            for corner in block.cuboid.corners() {
                let mut meets = |normal: Vec3A, gap: f32| {
                    if gap < margin {
                        let (along, across) = Contact::tangents(normal, Vec3A::X);
                        block.contacts.push(Contact {
                            link: 0,
                            arm: corner - block.cuboid.centre,
                            other: Other::Fixed,
                            other_arm: Vec3A::ZERO,
                            normal,
                            along,
                            across,
                            gap,
                            friction: [block.friction; 2],
                            held: 0.0,
                        });
                    }
                };
                meets(Vec3A::Z, corner.z);
                for solid in &self.solids {
                    let near = solid.near_point(corner);
                    meets(near.normal, near.distance);
                }
            }
        }
    }

    /// Contacts of links whose modules are not neighbours; the capsules of neighbours overlap by construction. The friction's axis is that of
    /// the link nearer to the tail.
    fn find_self_contacts(&mut self, robot: &Robot, margin: f32) {
        let per = robot.links_per_module;
        let reach = robot.link_length * per as f32 + 2.0 * robot.link_radius + margin;
        let middle = |links: &[Link], module: usize| {
            let link = &links[module * per + per / 2];
            link.anchor
        };
        for one in 0..robot.modules {
            for two in one + 2..robot.modules {
                if middle(&self.links, one).distance_squared(middle(&self.links, two)) > reach * reach {
                    continue;
                }
                for j in two * per..(two + 1) * per {
                    let second = &self.links[j];
                    for i in one * per..(one + 1) * per {
                        let first = &self.links[i];
                        let far = robot.link_length + 2.0 * robot.link_radius + margin;
                        if Self::centre(first).distance_squared(Self::centre(second)) > far * far {
                            continue;
                        }
                        let (p, q) = collide::near_segments(
                            [first.anchor, first.anchor + first.r],
                            [second.anchor, second.anchor + second.r],
                        );
                        let apart = q - p;
                        let distance = apart.length();
                        let gap = distance - 2.0 * robot.link_radius;
                        if gap > margin {
                            continue;
                        }
                        let normal = if distance > 1e-6 { apart / distance } else { Vec3A::Z };
                        let (along, across) = Contact::tangents(normal, second.r * (-1.0 / robot.link_length));
                        self.contacts.push(Contact {
                            link: j,
                            arm: q - robot.link_radius * normal - second.anchor,
                            other: Other::Link(i),
                            other_arm: p + robot.link_radius * normal - first.anchor,
                            normal,
                            along,
                            across,
                            gap,
                            friction: [robot.friction_along, robot.friction_across],
                            held: 0.0,
                        });
                    }
                }
            }
        }
    }

    /// Gradient and Hessian of `E` at the twists of this iteration.
    fn evaluate(&mut self, robot: &Robot, law: &Law, curvature: f32) {
        let (dt, mass, moment) = (law.dt, robot.link_mass, robot.link_inertia);
        let held = self.held;
        let respond = |contact: &Contact, velocity: Vec3A| match held {
            true => law.respond_held(contact, velocity, curvature),
            false => law.respond(contact, velocity, curvature),
        };
        let fall = self.gravity * dt;
        for link in &mut self.links {
            let centre = 0.5 * link.r;
            let f = mass * (link.twist.f + link.twist.n.cross(centre) - link.old.f - fall);
            let n = moment * (link.twist.n - link.old.n) + centre.cross(f);
            link.gradient = Spatial { n, f };
            link.hessian = link.inertia;
        }
        for joint in self.joints.iter_mut().skip(1) {
            joint.gradient =
                dt * (robot.stiffness * (joint.angle + dt * joint.speed) + joint.damping * joint.speed - joint.torque);
        }
        if let Some(block) = &mut self.block {
            let f = block.mass * (block.twist.f - block.old.f - fall);
            let n = block.inertia * block.twist.n - block.momentum;
            block.gradient = Spatial { n, f };
            let mass = Mat3A::from_diagonal(rapier3d::glamx::glam::Vec3::splat(block.mass));
            block.hessian = Block { a: block.inertia, b: Mat3A::ZERO, c: mass };
            for contact in &block.contacts {
                let velocity = block.twist.twist_at(contact.arm).f;
                if let Some(response) = respond(contact, velocity) {
                    block.gradient.n -= contact.arm.cross(response.impulse);
                    block.gradient.f -= response.impulse;
                    block.hessian.add_lifted(response.hessian, contact.arm);
                }
            }
        }
        self.couplings.clear();
        for contact in &self.contacts {
            let velocity = relative_velocity(&self.links, self.block.as_ref(), contact);
            let Some(response) = respond(contact, velocity) else { continue };
            let Response { impulse, mut hessian } = response;
            let couplings = &mut self.couplings;
            let mut in_tree = true;
            match (contact.other, &mut self.block) {
                (Other::Link(other), _) => {
                    in_tree = couplings.hessians.len() == SELF_CONTACTS;
                    let link = &mut self.links[other];
                    link.gradient.n += contact.other_arm.cross(impulse);
                    link.gradient.f += impulse;
                    if in_tree {
                        hessian *= 2.0;
                        link.hessian.add_lifted(hessian, contact.other_arm);
                    } else {
                        for unit in [Vec3A::X, Vec3A::Y, Vec3A::Z] {
                            for (link, arm, f) in [(contact.link, contact.arm, unit), (other, contact.other_arm, -unit)]
                            {
                                let wrench = Spatial { n: arm.cross(f), f };
                                couplings.entries.push(Entry { link, column: couplings.count, wrench });
                            }
                            couplings.count += 1;
                        }
                        couplings.hessians.push(hessian);
                    }
                }
                (Other::Block, Some(block)) => {
                    // Contacts with the block come before those between links.
                    couplings.block = true;
                    couplings.count = 6;
                    block.gradient.n += contact.other_arm.cross(impulse);
                    block.gradient.f += impulse;
                    block.hessian.add_lifted(hessian, contact.other_arm);
                    // -J_link^T K J_block, column by column: the velocity at the contact from each of the block's six.
                    for (k, unit) in [Vec3A::X, Vec3A::Y, Vec3A::Z].into_iter().enumerate() {
                        for (column, velocity) in [(k, unit.cross(contact.other_arm)), (3 + k, unit)] {
                            let f = -(hessian * velocity);
                            let wrench = Spatial { n: contact.arm.cross(f), f };
                            couplings.entries.push(Entry { link: contact.link, column, wrench });
                        }
                    }
                }
                _ => {}
            }
            let link = &mut self.links[contact.link];
            link.gradient.n -= contact.arm.cross(impulse);
            link.gradient.f -= impulse;
            if in_tree {
                link.hessian.add_lifted(hessian, contact.arm);
            }
        }
        self.couplings.entries.sort_by_key(|entry| std::cmp::Reverse(entry.link));
    }

    /// One step of Newton: sets the steps of head, joints, links and block. Returns `-gradient . step`.
    fn sweep(&mut self, robot: &Robot, dt: f32) -> f32 {
        let mut hessian = Block::ZERO;
        let mut p = Spatial::ZERO;
        let stiffness = dt * dt * robot.stiffness;
        let couplings = &mut self.couplings;
        let count = couplings.count;
        for row in &mut couplings.gram[..count] {
            row[..count].fill(0.0);
        }
        couplings.against[..count].fill(0.0);
        let mut columns = [Spatial::ZERO; COLUMNS];
        let mut entries = couplings.entries.iter().peekable();
        for i in (0..self.links.len()).rev() {
            let link = &self.links[i];
            hessian.add(&link.hessian);
            p.n += link.gradient.n;
            p.f += link.gradient.f;
            while let Some(entry) = entries.next_if(|entry| entry.link == i) {
                columns[entry.column].add_scaled(entry.wrench, 1.0);
            }
            if i == 0 {
                break;
            }
            let s = link.hinge;
            let joint = &mut self.joints[i];
            // U = H (s, 0).
            let un = hessian.a * s;
            let uf = Vec3A::new(hessian.b.x_axis.dot(s), hessian.b.y_axis.dot(s), hessian.b.z_axis.dot(s));
            let d = s.dot(un) + dt * joint.damping + stiffness;
            joint.inverse_d = 1.0 / d;
            joint.u = joint.gradient + s.dot(p.n);
            self.reach[i] = Spatial { n: un, f: uf };
            let (scaled_n, scaled_f) = (un * joint.inverse_d, uf * joint.inverse_d);
            hessian.a = less_outer(hessian.a, scaled_n, un);
            hessian.b = less_outer(hessian.b, scaled_n, uf);
            hessian.c = less_outer(hessian.c, scaled_f, uf);
            p.add_scaled(self.reach[i], -joint.u * joint.inverse_d);
            let r = self.links[i - 1].r;
            let left = &mut couplings.left[i];
            for k in 0..count {
                left[k] = s.dot(columns[k].n);
                let scaled = left[k] * joint.inverse_d;
                columns[k].add_scaled(self.reach[i], -scaled);
                columns[k] = columns[k].wrench_moved(r);
                couplings.against[k] += scaled * joint.u;
                for l in 0..=k {
                    couplings.gram[k][l] += scaled * left[l];
                }
            }
            hessian = hessian.moved(r);
            p = p.wrench_moved(r);
        }
        // The head, then what is coupled through it.
        let factors = hessian.factors();
        let mut step = solve(&factors, Spatial { n: -p.n, f: -p.f });
        if count > 0 {
            let solved: [Spatial; COLUMNS] =
                std::array::from_fn(|k| if k < count { solve(&factors, columns[k]) } else { Spatial::ZERO });
            for k in 0..count {
                couplings.against[k] -= columns[k].dot(step);
                for l in 0..=k {
                    couplings.gram[k][l] += columns[k].dot(solved[l]);
                    couplings.gram[l][k] = couplings.gram[k][l];
                }
            }
            couplings.solve(self.block.as_ref().map(|b| (&b.hessian, b.gradient)));
            for (solved, by) in solved.iter().zip(&couplings.solution[..count]) {
                step.add_scaled(*solved, -by);
            }
        }
        if let Some(block) = &mut self.block {
            block.step = if couplings.block {
                let x = couplings.solution;
                Spatial { n: Vec3A::new(x[0], x[1], x[2]), f: Vec3A::new(x[3], x[4], x[5]) }
            } else {
                solve(&block.hessian.factors(), Spatial { n: -block.gradient.n, f: -block.gradient.f })
            };
        }
        let mut gain = 0.0;
        for i in 0..self.links.len() {
            if i > 0 {
                step = step.twist_at(self.links[i - 1].r);
                let joint = &mut self.joints[i];
                let coupled: f32 = couplings.left[i][..count].iter().zip(&couplings.solution).map(|(a, b)| a * b).sum();
                joint.step = -(joint.u + self.reach[i].dot(step) + coupled) * joint.inverse_d;
                step.n += self.links[i].hinge * joint.step;
                gain -= joint.gradient * joint.step;
            }
            self.links[i].step = step;
            gain -= self.links[i].gradient.dot(step);
        }
        gain - self.block.as_ref().map_or(0.0, |b| b.gradient.dot(b.step))
    }

    /// Adds `share` of the step of Newton to the velocities.
    fn advance(&mut self, share: f32) {
        for link in &mut self.links {
            link.twist.add_scaled(link.step, share);
        }
        for joint in &mut self.joints {
            joint.speed += share * joint.step;
        }
        if let Some(block) = &mut self.block {
            block.twist.add_scaled(block.step, share);
        }
    }

    /// Slope of `E` along the step of Newton.
    fn slope(&self) -> f32 {
        let links: f32 = self.links.iter().map(|link| link.gradient.dot(link.step)).sum();
        let joints: f32 = self.joints.iter().map(|joint| joint.gradient * joint.step).sum();
        links + joints + self.block.as_ref().map_or(0.0, |b| b.gradient.dot(b.step))
    }

    /// Having gone a whole step of Newton, goes back to where `E` has about its minimum along it if that was too far: the slope there is at
    /// most half of the one at its start, `-gain`. Leaves gradient and Hessian of the place.
    fn search(&mut self, robot: &Robot, law: &Law, curvature: f32, gain: f32) {
        let (mut low, mut low_slope) = (0.0f32, -gain);
        let (mut high, mut high_slope) = (1.0f32, f32::INFINITY);
        let mut at = 1.0f32;
        for trial in 0.. {
            self.evaluate(robot, law, curvature);
            let slope = self.slope();
            if slope.abs() <= 0.5 * gain || (at == 1.0 && slope < 0.0) || trial == TRIALS {
                return;
            }
            if slope > 0.0 {
                (high, high_slope) = (at, slope)
            } else {
                (low, low_slope) = (at, slope)
            }
            // The slope often stays small until a contact closes and then rises steeply: a straight line between the two would
            // lead back to the start, so go a tenth of the way at least.
            let root = low_slope / (low_slope - high_slope);
            let next = low + (high - low) * root.clamp(0.1, 0.9);
            self.advance(next - at);
            at = next;
        }
    }

    /// Twists of all links from the head's and the joints' speeds.
    fn spread(&mut self) {
        for i in 1..self.links.len() {
            let mut twist = self.links[i - 1].twist.twist_at(self.links[i - 1].r);
            twist.n += self.links[i].hinge * self.joints[i].speed;
            self.links[i].twist = twist;
        }
    }

    /// The velocities after the last step, at this place.
    fn begin(&mut self) {
        let head = &mut self.links[0];
        head.twist = Spatial { n: head.old.n, f: head.old.f - head.old.n.cross(0.5 * head.r) };
        self.joints.iter_mut().for_each(|joint| joint.speed = joint.old);
        if let Some(block) = &mut self.block {
            block.twist = block.old;
        }
        self.spread();
    }

    /// Velocities at the end of the step.
    fn solve(&mut self, robot: &Robot, law: &Law) {
        self.effort.steps += 1;
        self.held = false;
        self.begin();
        if self.newton(robot, law).is_some() {
            return;
        }
        self.effort.held += 1;
        self.held = true;
        self.begin();
        for _ in 0..HELD_ROUNDS {
            match self.newton(robot, law) {
                None => break,
                // Nothing was left to be gained with these loads.
                Some(1) => return,
                Some(_) => self.take_over_loads(law),
            }
        }
        self.effort.capped += 1;
    }

    /// Newton's method from the velocities as they are. The sweeps it took; none if they did not lead there.
    fn newton(&mut self, robot: &Robot, law: &Law) -> Option<usize> {
        self.evaluate(robot, law, 0.0);
        let tolerance = robot.solver_tolerance * law.dt;
        for sweeps in 1..=robot.solver_iterations {
            let gain = self.sweep(robot, law.dt);
            self.effort.sweeps += 1;
            // Not a number, or uphill.
            if gain.is_nan() || gain <= -tolerance {
                return None;
            }
            self.advance(1.0);
            if gain < tolerance {
                return Some(sweeps);
            }
            let curvature = if sweeps < CAREFUL_SWEEPS { 0.0 } else { CURVATURE };
            self.search(robot, law, curvature, gain);
        }
        None
    }

    /// Brings the loads that are held nearer to what the contacts bear at these velocities.
    fn take_over_loads(&mut self, law: &Law) {
        let nearer = |contact: &mut Contact, velocity: Vec3A| {
            contact.held += TAKEN_OVER * (law.load(contact, velocity) - contact.held);
        };
        for contact in &mut self.contacts {
            nearer(contact, relative_velocity(&self.links, self.block.as_ref(), contact));
        }
        if let Some(block) = &mut self.block {
            for contact in &mut block.contacts {
                nearer(contact, block.twist.twist_at(contact.arm).f);
            }
        }
    }

    /// One step: `torque` is that on each axis of each module.
    pub fn step(&mut self, robot: &Robot, torque: &[[f32; 2]]) {
        let dt = robot.physics_step;
        let law = Law {
            dt,
            stiffness: robot.contact_stiffness,
            damping: robot.contact_damping,
            slip_speed: robot.slip_speed,
        };
        for i in 1..self.joints.len() {
            let joint = &mut self.joints[i];
            joint.old = joint.speed;
            let (module, axis) = robot.motor_of(i - 1);
            joint.torque = torque[module][axis];
            joint.damping = robot.damping_at(joint.speed);
        }
        self.find_contacts(robot);
        self.solve(robot, &law);
        self.integrate(robot, dt);
    }

    /// Moves everything by the velocities of the step.
    fn integrate(&mut self, robot: &Robot, dt: f32) {
        let mut centre = Vec3A::ZERO;
        for link in &mut self.links {
            link.old = link.twist.twist_at(0.5 * link.r);
            centre += Self::centre(link) + dt * link.old.f;
        }
        for joint in &mut self.joints {
            joint.angle += dt * joint.speed;
        }
        let head = &mut self.links[0];
        let rotation = rotation_by(dt * head.twist.n) * head.rotation;
        head.rotation = rotation * (1.5 - 0.5 * rotation.length_squared());
        self.place(robot);
        // The centre of mass goes where its velocity takes it; the head's pose alone would let it drift.
        let mut off = centre;
        for link in &self.links {
            off -= Self::centre(link);
        }
        off /= self.links.len() as f32;
        self.links.iter_mut().for_each(|link| link.anchor += off);
        if let Some(block) = &mut self.block {
            block.old = block.twist;
            block.momentum = block.inertia * block.twist.n;
            block.cuboid.centre += dt * block.twist.f;
            let rotation = rotation_by(dt * block.twist.n) * block.rotation;
            block.rotation = rotation * (1.5 - 0.5 * rotation.length_squared());
            block.turn();
        }
    }

    /// Writes where everything is, and how it moves.
    pub fn write(&self, state: &mut State) {
        for (link, out) in self.links.iter().zip(&mut state.links) {
            out.position = Self::centre(link).to_array();
            out.rotation = link.rotation.to_array();
            out.linear = link.old.f.to_array();
            out.angular = link.old.n.to_array();
        }
        for (joint, (angle, speed)) in
            self.joints.iter().skip(1).zip(state.joint_angles.iter_mut().zip(&mut state.joint_speeds))
        {
            (*angle, *speed) = (joint.angle, joint.speed);
        }
        if let (Some(block), Some(out)) = (&self.block, &mut state.block) {
            out.position = block.cuboid.centre.to_array();
            out.rotation = block.rotation.to_array();
            out.linear = block.old.f.to_array();
            out.angular = block.twist.n.to_array();
        }
    }

    /// Takes velocities of links and block from outside; the links' are projected onto what the joints allow (the head's and the joints' count).
    #[cfg(test)]
    pub fn throw(&mut self, velocity: [f32; 3]) {
        for link in &mut self.links {
            link.old = Spatial { n: Vec3A::ZERO, f: Vec3A::from(velocity) };
        }
        self.joints.iter_mut().for_each(|joint| joint.speed = 0.0);
    }

    /// Moves the whole snake.
    #[cfg(test)]
    pub fn shift(&mut self, by: [f32; 3]) {
        self.links.iter_mut().for_each(|link| link.anchor += Vec3A::from(by));
    }

    /// Pulls everything elsewhere than down.
    #[cfg(test)]
    pub fn pull(&mut self, gravity: [f32; 3]) {
        self.gravity = Vec3A::from(gravity);
    }

    /// Gives the block a velocity.
    #[cfg(test)]
    pub fn push_block(&mut self, velocity: [f32; 3]) {
        if let Some(block) = &mut self.block {
            block.twist.f = Vec3A::from(velocity);
            block.old = block.twist;
        }
    }

    /// Deepest contact now, units.
    pub fn penetration(&mut self, robot: &Robot) -> f32 {
        self.find_contacts(robot);
        self.contacts.iter().map(|c| -c.gap).fold(0.0, f32::max)
    }
}
