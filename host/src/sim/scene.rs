//! What stands on the ground besides the snake.

use rapier3d::prelude::*;

use super::SCENE;

/// A box that does not move: a wall, a panel of a tube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solid {
    /// Half of each edge along its own axes, units.
    pub half: [f32; 3],
    /// Centre in the world, units.
    pub position: [f32; 3],
    /// Turn about the world's z axis, rad; after `roll`.
    pub yaw: f32,
    /// Turn about its own x axis, rad.
    pub roll: f32,
}

impl Solid {
    /// Its rotation, quaternion x, y, z, w.
    pub fn rotation(&self) -> [f32; 4] {
        let ((sy, cy), (sr, cr)) = (libm::sincosf(0.5 * self.yaw), libm::sincosf(0.5 * self.roll));
        [cy * sr, sy * sr, sy * cr, cy * cr]
    }

    fn collider(&self) -> ColliderBuilder {
        let [x, y, z] = self.half;
        let [px, py, pz] = self.position;
        let [a, b, c, d] = self.rotation();
        ColliderBuilder::cuboid(x, y, z)
            .position(Pose::from_parts(Vector::new(px, py, pz), Rotation::from_xyzw(a, b, c, d)))
            .friction(0.0)
            .collision_groups(SCENE)
    }
}

/// A box that can be pushed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// Half of each edge, units.
    pub half: [f32; 3],
    /// Centre in the world at the start, units.
    pub position: [f32; 3],
    /// Turn about the world's z axis at the start, rad.
    pub yaw: f32,
    /// Mass, kg.
    pub mass: f32,
    /// Coefficient of friction with the ground and with the snake's body.
    pub friction: f32,
}

/// Everything on the ground besides the snake.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// What does not move.
    pub solids: Vec<Solid>,
    /// What can be pushed.
    pub block: Option<Block>,
}

impl Scene {
    /// Puts it all into the world; returns the body of the block.
    pub(super) fn build(&self, world: &mut PhysicsWorld) -> Option<RigidBodyHandle> {
        for solid in &self.solids {
            world.colliders.insert(solid.collider().build());
        }
        let block = self.block?;
        let [x, y, z] = block.position;
        let body = RigidBodyBuilder::dynamic()
            .translation(Vector::new(x, y, z))
            .rotation(Vector::new(0.0, 0.0, block.yaw))
            .can_sleep(false);
        let handle = world.bodies.insert(body);
        let [hx, hy, hz] = block.half;
        // Its friction counts, whatever the other side's: rapier's own isotropic friction keeps a block at rest at rest.
        let collider = ColliderBuilder::cuboid(hx, hy, hz)
            .mass(block.mass)
            .friction(block.friction)
            .friction_combine_rule(CoefficientCombineRule::Max)
            .collision_groups(SCENE);
        world.colliders.insert_with_parent(collider, handle, &mut world.bodies);
        Some(handle)
    }
}
