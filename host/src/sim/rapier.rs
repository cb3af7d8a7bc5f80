//! The second opinion: the same snake with rapier's own joints, contacts and solver (`--solver rapier`).
//!
//! A chain of capsules joined by impulse joints. A joint's spring, its motor and the motor's torque-speed line are one implicit
//! spring-damper: the torque `tau` moves the spring's target to `tau / k`. What differs from the direct solver, and is no mistake of either:
//!
//! - Friction is dry, as constraints of rapier's solver: each loaded contact has a joint that locks nothing and whose two linear motors hold the
//!   link along and across with a limited force: a rectangle whose corner lies on the ellipse of maximal dissipation, in the direction in which the
//!   contact slid in the last sub-step, for the load of the last sub-step. (A fixed rectangle, the usual pyramid, makes the gait 15 % slower.)
//! - The block rubs on the ground by rapier's own friction, at each of its contact points.
//! - Contacts are rapier's springs, 240 Hz (480 Hz against what does not move), critically damped.
//! - Joints may open a little; 4 sub-steps of 16 iterations keep the chain together (`rapier_substeps`, `rapier_iterations`).
//! - Links do not rub on each other.

use rapier3d::dynamics::{JointAxesMask, JointEnabled};
use rapier3d::prelude::*;

use super::scene::Scene;
use super::{LinkState, State};
use crate::robot::Robot;

/// Natural frequency of contacts, Hz, and its share against bodies that do not move.
const CONTACT_FREQUENCY: f32 = 240.0;
/// Contacts of a link with what does not move that have friction.
const SLOTS: usize = 2;
/// How hard friction holds what it can hold, force per unit/s.
const HOLD: f32 = 1e4;

/// Collision group of everything besides the snake.
const SCENE: InteractionGroups = InteractionGroups::new(Group::GROUP_32, Group::ALL, InteractionTestMode::And);

/// Collision groups: one bit for the scene, 31 that the modules share in turn. A link meets the scene and the links of
/// modules that are not its neighbours (the capsules of neighbours overlap by construction).
fn groups(module: usize) -> InteractionGroups {
    let bit = |m: usize| 1u32 << (m % 31);
    let near = bit(module) | bit(module + 1) | bit(module + 30);
    InteractionGroups::new(
        Group::from_bits_retain(bit(module)),
        Group::from_bits_retain(!near),
        InteractionTestMode::And,
    )
}

/// A loaded contact of a link.
struct Loaded {
    link: usize,
    /// Whether with the block.
    block: bool,
    point: Vector,
    normal: Vector,
    load: f32,
}

/// The snake and its scene in rapier's world.
pub struct RapierSnake {
    world: PhysicsWorld,
    links: Vec<RigidBodyHandle>,
    block: Option<RigidBodyHandle>,
    joints: Vec<ImpulseJointHandle>,
    /// Friction of each link with what does not move, and with the block.
    still: Vec<[ImpulseJointHandle; SLOTS]>,
    on_block: Vec<ImpulseJointHandle>,
    loaded: Vec<Loaded>,
}

impl RapierSnake {
    /// A straight snake at rest, its head link centred at the origin, in a scene.
    pub fn new(robot: &Robot, scene: &Scene) -> Self {
        let mut world = PhysicsWorld { gravity: Vector::from(robot.gravity_vector()), ..PhysicsWorld::default() };
        let parameters = &mut world.integration_parameters;
        parameters.dt = robot.physics_step / robot.rapier_substeps as f32;
        parameters.num_solver_iterations = robot.rapier_iterations;
        parameters.num_internal_stabilization_iterations = 0;
        parameters.max_ccd_substeps = 0;
        parameters.contact_softness = SpringCoefficients::new(CONTACT_FREQUENCY, 1.0);
        parameters.static_contact_softness = SpringCoefficients::new(2.0 * CONTACT_FREQUENCY, 1.0);
        // Contacts that start from their last impulses in full push harder than the chain holds.
        parameters.warmstart_coefficient = 0.7;
        parameters.contact_clustering = false;
        // The other model joins a manifold's friction in its centre; a block that is pushed turns too easily then.
        parameters.friction_model = FrictionModel::Coulomb;
        // Friction that rapier itself applies is that of the block on ground and solids: the product of the two coefficients.
        let on_scene = scene.block.map_or(0.0, |block| block.friction);
        let multiply = CoefficientCombineRule::Multiply;
        world.colliders.insert(
            ColliderBuilder::halfspace(rapier3d::na::Unit::new_unchecked(Vector::Z))
                .friction(on_scene)
                .friction_combine_rule(multiply)
                .collision_groups(SCENE)
                .build(),
        );
        for solid in &scene.solids {
            let [x, y, z] = solid.half;
            let [px, py, pz] = solid.position;
            let [a, b, c, d] = solid.rotation();
            world.colliders.insert(
                ColliderBuilder::cuboid(x, y, z)
                    .position(Pose::from_parts(Vector::new(px, py, pz), Rotation::from_xyzw(a, b, c, d)))
                    .friction(on_scene)
                    .friction_combine_rule(multiply)
                    .collision_groups(SCENE)
                    .build(),
            );
        }
        let block = scene.block.map(|block| {
            let [x, y, z] = block.position;
            let body = RigidBodyBuilder::dynamic()
                .translation(Vector::new(x, y, z))
                .rotation(Vector::new(0.0, 0.0, block.yaw))
                .can_sleep(false);
            let handle = world.bodies.insert(body);
            let [hx, hy, hz] = block.half;
            let collider = ColliderBuilder::cuboid(hx, hy, hz)
                .mass(block.mass)
                .friction(1.0)
                .friction_combine_rule(multiply)
                .collision_groups(SCENE);
            world.colliders.insert_with_parent(collider, handle, &mut world.bodies);
            handle
        });
        let earth = world.bodies.insert(RigidBodyBuilder::fixed());
        let (length, radius) = (robot.link_length, robot.link_radius);
        let mut links: Vec<RigidBodyHandle> = Vec::with_capacity(robot.links());
        let mut joints = Vec::with_capacity(robot.links().saturating_sub(1));
        for link in 0..robot.links() {
            let module = link / robot.links_per_module;
            let body = RigidBodyBuilder::dynamic()
                .translation(Vector::new(-(link as f32) * length, 0.0, radius))
                .can_sleep(false)
                .additional_mass_properties(MassProperties::new(
                    Vector::ZERO,
                    robot.link_mass,
                    Vector::splat(robot.link_inertia),
                ));
            let handle = world.bodies.insert(body);
            let collider = ColliderBuilder::capsule_x(0.5 * length, radius)
                .density(0.0)
                .friction(0.0)
                .friction_combine_rule(multiply)
                .collision_groups(groups(module))
                .user_data(link as u128);
            world.colliders.insert_with_parent(collider, handle, &mut world.bodies);
            if let Some(&front) = links.last() {
                let axis = Vector::from(robot.joint_axis(link - 1));
                let joint = GenericJointBuilder::new(JointAxesMask::LOCKED_REVOLUTE_AXES)
                    .local_axis1(axis)
                    .local_axis2(axis)
                    .local_anchor1(Vector::new(-0.5 * length, 0.0, 0.0))
                    .local_anchor2(Vector::new(0.5 * length, 0.0, 0.0))
                    .motor_model(JointAxis::AngX, MotorModel::ForceBased)
                    .set_motor(JointAxis::AngX, 0.0, 0.0, robot.stiffness, robot.damping_at(0.0))
                    .contacts_enabled(false)
                    .build();
                joints.push(world.impulse_joints.insert(front, handle, joint, true));
            }
            links.push(handle);
        }
        let mut friction = |from: RigidBodyHandle, link: RigidBodyHandle| {
            let mut joint = GenericJointBuilder::new(JointAxesMask::empty())
                .motor_model(JointAxis::LinX, MotorModel::ForceBased)
                .motor_model(JointAxis::LinY, MotorModel::ForceBased)
                .set_motor(JointAxis::LinX, 0.0, 0.0, 0.0, HOLD)
                .set_motor(JointAxis::LinY, 0.0, 0.0, 0.0, HOLD)
                .build();
            joint.enabled = JointEnabled::Disabled;
            world.impulse_joints.insert(from, link, joint, true)
        };
        let still = links.iter().map(|&link| std::array::from_fn(|_| friction(earth, link))).collect();
        let on_block = block.map_or(Vec::new(), |b| links.iter().map(|&link| friction(b, link)).collect());
        RapierSnake { world, links, block, joints, still, on_block, loaded: Vec::new() }
    }

    /// One step: `torque` is that on each axis of each module, `speeds` those of the joints now.
    pub fn step(&mut self, robot: &Robot, torque: &[[f32; 2]], speeds: &[f32]) {
        for (index, speed) in speeds.iter().enumerate() {
            let (module, axis) = robot.motor_of(index);
            if let Some(joint) = self.world.impulse_joints.get_mut(self.joints[index], false) {
                let motor = &mut joint.data.motors[JointAxis::AngX as usize];
                motor.target_pos = torque[module][axis] / robot.stiffness;
                motor.damping = robot.damping_at(*speed);
            }
        }
        for _ in 0..robot.rapier_substeps {
            self.rub(robot);
            self.world.step();
        }
    }

    /// Sets the friction of each link to the loads of the last step.
    fn rub(&mut self, robot: &Robot) {
        self.find_loads(self.world.integration_parameters.dt);
        for handle in self.still.iter().flatten().chain(&self.on_block) {
            if let Some(joint) = self.world.impulse_joints.get_mut(*handle, false) {
                joint.data.enabled = JointEnabled::Disabled;
            }
        }
        let mut used = vec![0; self.links.len()];
        for contact in &self.loaded {
            let handle = if contact.block {
                self.on_block[contact.link]
            } else if used[contact.link] < SLOTS {
                used[contact.link] += 1;
                self.still[contact.link][used[contact.link] - 1]
            } else {
                continue;
            };
            let Some(joint) = self.world.impulse_joints.get_mut(handle, false) else { continue };
            let link_body = &self.world.bodies[self.links[contact.link]];
            let link = link_body.position();
            let normal = contact.normal;
            let axis = link.rotation * Vector::X;
            let along = (axis - normal * axis.dot(normal)).try_normalize().unwrap_or(normal.any_orthonormal_vector());
            let across = normal.cross(along);
            let frame = Rotation::from_mat3(&Matrix::from_cols(along, across, normal));
            let world = Pose::from_parts(contact.point, frame);
            let (first, other) = match self.block.filter(|_| contact.block) {
                Some(block) => {
                    let block = &self.world.bodies[block];
                    (*block.position(), velocity(block, contact.point))
                }
                None => (Pose::IDENTITY, Vector::ZERO),
            };
            joint.data.local_frame1 = first.inverse() * world;
            joint.data.local_frame2 = link.inverse() * world;
            joint.data.enabled = JointEnabled::Enabled;
            let limits = limits([robot.friction_along, robot.friction_across], robot.slip_speed, {
                let slip = velocity(link_body, contact.point) - other;
                [slip.dot(along), slip.dot(across)]
            });
            for (axis, share) in [JointAxis::LinX, JointAxis::LinY].into_iter().zip(limits) {
                joint.data.motors[axis as usize].max_force = share * contact.load;
            }
        }
    }

    /// The links' loaded contacts of the last step with ground, solids and block; the heaviest come first.
    fn find_loads(&mut self, dt: f32) {
        self.loaded.clear();
        for pair in self.world.narrow_phase.contact_pairs() {
            let colliders = [pair.collider1, pair.collider2].map(|handle| &self.world.colliders[handle]);
            let parents = colliders.map(Collider::parent);
            let block = self.block.is_some() && parents.contains(&self.block);
            let links = [0, 1].map(|side| {
                parents[side].filter(|p| Some(*p) != self.block).map(|_| colliders[side].user_data as usize)
            });
            let ([Some(link), None] | [None, Some(link)]) = links else { continue };
            for manifold in pair.solver_manifolds() {
                let load: f32 = manifold.points.iter().map(|p| p.data.impulse).sum::<f32>() / dt;
                if load <= 0.0 {
                    continue;
                }
                // The frame of the first collider carries the contact point; impulses weigh the points of a line contact.
                let weighted: Vector = manifold.points.iter().map(|p| p.local_p1 * p.data.impulse).sum();
                let point = colliders[0].position().transform_point(weighted / (load * dt));
                self.loaded.push(Loaded { link, block, point, normal: manifold.data.normal, load });
            }
        }
        self.loaded.sort_by(|a, b| b.load.total_cmp(&a.load));
    }

    /// Writes where everything is, and how it moves.
    pub fn write(&self, robot: &Robot, state: &mut State) {
        for (link, out) in self.links.iter().zip(&mut state.links) {
            *out = of(&self.world.bodies[*link]);
        }
        for index in 0..self.joints.len() {
            let (front, rear) = (&self.world.bodies[self.links[index]], &self.world.bodies[self.links[index + 1]]);
            let axis = Vector::from(robot.joint_axis(index));
            state.joint_speeds[index] = (rear.angvel() - front.angvel()).dot(front.rotation() * axis);
            let relative = front.rotation().inverse() * *rear.rotation();
            let angle = 2.0 * libm::atan2f(Vector::new(relative.x, relative.y, relative.z).dot(axis), relative.w);
            // q and -q are the same rotation.
            state.joint_angles[index] = libm::remainderf(angle, std::f32::consts::TAU);
        }
        if let (Some(block), Some(out)) = (self.block, &mut state.block) {
            *out = of(&self.world.bodies[block]);
        }
    }
}

/// How fast the point of `body` that is at `point` moves.
fn velocity(body: &RigidBody, point: Vector) -> Vector {
    body.linvel() + body.angvel().cross(point - body.translation())
}

/// The most that friction may hold along and across, as shares of the load, at a contact that slides this fast: the corner of the
/// rectangle that lies on the ellipse of the other solver's law ([`super::contact`]) in the direction of maximal dissipation. A contact that
/// holds has the rectangle with the corners half-way round.
fn limits(friction: [f32; 2], slip_speed: f32, sliding: [f32; 2]) -> [f32; 2] {
    let [y1, y2] = [friction[0] * sliding[0], friction[1] * sliding[1]];
    let eps = slip_speed * friction[0].min(friction[1]);
    let all = (y1 * y1 + y2 * y2 + eps * eps).sqrt();
    [friction[0] * (y1 * y1 + 0.5 * eps * eps).sqrt() / all, friction[1] * (y2 * y2 + 0.5 * eps * eps).sqrt() / all]
}

fn of(body: &RigidBody) -> LinkState {
    let r = body.rotation();
    LinkState {
        position: body.translation().to_array(),
        rotation: [r.x, r.y, r.z, r.w],
        linear: body.linvel().to_array(),
        angular: body.angvel().to_array(),
    }
}
