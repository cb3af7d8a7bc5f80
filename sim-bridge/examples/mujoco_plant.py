#!/usr/bin/env python3
"""MuJoCo as the plant of the simulated bus, and as a judge of the simulator's physics.

    mujoco_plant.py                                    speak the plant protocol (../plant-protocol.md) on standard input and output
    mujoco_plant.py --listen PORT                      the same on a loopback TCP port, one connection after the other (0: any free port)
    mujoco_plant.py --gait --model FILE                head x after ten seconds of an open-loop gait, under the same contact law
    mujoco_plant.py --gait --own-contacts --model FILE the same under MuJoCo's own contacts, and how fast they are

Needs `mujoco` and `numpy` (mujoco_plant.requirements.txt has the versions). FILE is what `snakectl mjcf` writes.

What is whose. MuJoCo: the model, kinematics, mass matrix, Coriolis, centrifugal and gravity forces, the integration of positions, and the
collision of capsules with boxes and with each other. Here: the contacts of end spheres and of the block's corners with the ground, the law of
contact, and the step of the velocities; MuJoCo's own constraint solver is not used (except with --own-contacts).

The law, at every contact of the snake, units of the robot: a normal force

    N = contact_stiffness * max(0, penetration) * max(0, 1 - contact_damping * v_n)        (Hunt and Crossley; v_n: separating speed)

and friction of maximal dissipation within an ellipse: t1 is the link's axis in the contact plane, t2 = n x t1,

    y = (mu1 v1, mu2 v2), S = sqrt(|y|^2 + eps^2), force_i = -N mu_i y_i / S, eps = slip_speed * min(mu1, mu2).

On the block the link's coefficients count, between block and ground the block's own. A joint feels tau - k q - c q', and
c = (damping + torque_limit / joint_speed_limit) * (1 + 8 clamp(|q'| / joint_speed_limit - 1, 0, 1)).

The step. Contact and joint forces are those at the end of the internal step, found by a few iterations with the secant of the friction and the
tangent of the normal force, so that the step is bounded by accuracy and not by the stiffness at standstill. `--integrator explicit` leaves the
step to MuJoCo (`mj_step`) with these forces as `qfrc_applied`; it has to be some twenty times as small and is there to check the other.
"""

import argparse
import json
import math
import os
import socket
import sys
import time

# One plant is one thread: matrices are small, and episodes run side by side.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

try:
    import mujoco
    import numpy as np
except ImportError as error:
    sys.exit(f"mujoco_plant.py: {error}; install what mujoco_plant.requirements.txt lists")

PROTOCOL = "composer-plant"
VERSION = 1

# The longest internal step, s: half of it moves the gait's head by 0.13 % (--gait --internal-step).
INTERNAL_STEP = 1.0 / 1000.0
ITERATIONS = 2
OVERSPEED_BRAKE = 8.0
# Spheres and corners nearer to the ground than this take part in a step, units: they may arrive within it.
MARGIN = 0.1
# The module's own link, which carries its IMU.
OWN_LINK = 1

# What the model does not say; a reset has all of it.
DEFAULTS = {
    "torque_limit": 80.0,
    "torque_slew": 400.0,
    "joint_speed_limit": 3.0,
    "contact_stiffness": 2000.0,
    "contact_damping": 5.0,
    "slip_speed": 0.05,
}


class Refused(Exception):
    """Something asked for cannot be; the text is one sentence."""


def model_of(xml, own_contacts):
    """The model; without its own contacts the ground is left to this program."""
    try:
        spec = mujoco.MjSpec.from_string(xml)
        if not own_contacts:
            for pair in list(spec.pairs):
                spec.delete(pair)
            ground = spec.geom("ground")
            if ground is None:
                raise Refused("the model has no geom called ground")
            ground.contype = ground.conaffinity = 0
        return spec.compile()
    except ValueError as error:
        raise Refused(f"MuJoCo refuses the model: {' '.join(str(error).split())}") from None


class Plant:
    """One snake in its scene. `parameters` are fields of the robot by their names in a robot file; those missing come from the model."""

    def __init__(self, xml, parameters, modules=None, internal_step=INTERNAL_STEP, iterations=ITERATIONS, integrator="implicit",
                 own_contacts=False, imu=False):
        self.own_contacts = own_contacts
        self.imu = imu
        self.explicit = integrator == "explicit"
        self.internal_step = internal_step
        self.iterations = iterations
        m = self.m = model_of(xml, own_contacts)
        d = self.d = mujoco.MjData(m)
        self.block = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, "block")
        hinges = m.njnt - (2 if self.block >= 0 else 1)
        links = self.links = hinges + 1
        root = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, "root")
        if root != 0 or m.nv != 6 + hinges + (6 if self.block >= 0 else 0):
            raise Refused("the model is no snake as `snakectl mjcf` writes it: a free joint `root` first, then hinges, then a block")
        self.modules = modules or sum(m.body(b).name.endswith(".link0") for b in range(m.nbody))
        if self.modules < 1 or links % self.modules:
            raise Refused(f"the model has {links} links, which do not make {self.modules} modules")
        self.per_module = links // self.modules
        self.own = np.arange(self.modules) * self.per_module + min(OWN_LINK, self.per_module - 1)

        first = self.first = m.jnt_bodyid[root]
        self.bodies = slice(first, first + links)
        geom = m.body_geomadr[first]
        self.radius, self.half = float(m.geom_size[geom, 0]), float(m.geom_size[geom, 1])
        # Joint i turns with the yaw or pitch axis of the module whose link is before it.
        joints = np.arange(hinges)
        self.axis_of_joint = (joints // self.per_module, joints % self.per_module % 2)
        self.hinge = slice(6, 6 + hinges)
        get = lambda name: float(parameters.get(name, DEFAULTS[name]))
        self.speed_limit = get("joint_speed_limit")
        self.torque_limit, self.torque_slew = get("torque_limit"), get("torque_slew")
        self.stiffness = np.array(m.jnt_stiffness[1:1 + hinges]).reshape(hinges)
        self.damping = np.array(m.dof_damping[self.hinge]).reshape(hinges)
        self.k, self.h, slip = get("contact_stiffness"), get("contact_damping"), get("slip_speed")
        pairs = mujoco.MjModel.from_xml_string(xml).pair_friction
        self.mu = np.array([
            float(parameters.get("friction_along", pairs[0, 0] if len(pairs) else 0.1)),
            float(parameters.get("friction_across", pairs[0, 1] if len(pairs) else 1.0)),
        ])
        self.slip = slip
        self.eps = float(parameters.get("eps", slip * self.mu.min()))
        self.torque = np.zeros((self.modules, 2))

        # Which degrees of freedom move a body: a row for each link, the block, and the world.
        nv = m.nv
        self.moves = np.zeros((links + 2, nv))
        self.moves[:links, :6] = 1.0
        self.moves[:links, self.hinge] = np.tri(links, hinges, -1)
        if self.block >= 0:
            self.moves[links, -6:] = 1.0
            self.corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * m.geom_size[
                m.body_geomadr[self.block]]
            self.block_mu = float(m.geom_friction[m.body_geomadr[self.block], 0])
        self.row_of_geom = np.full(m.ngeom, links + 1)
        for g in range(m.ngeom):
            body = m.geom_bodyid[g]
            if first <= body < first + links:
                self.row_of_geom[g] = body - first
            elif body == self.block:
                self.row_of_geom[g] = links
        self.screws = np.zeros((6, nv))
        self.screws[3:, :3] = np.eye(3)
        if self.block >= 0:
            self.screws[3:, -6:-3] = np.eye(3)
        self.matrix, self.bias = np.zeros((nv, nv)), np.zeros(nv)
        self.ends = np.concatenate([np.arange(links)] * 2)
        self.up = np.array([0.0, 0.0, 1.0])
        if own_contacts:
            m.opt.timestep = internal_step
            if m.npair:
                m.pair_friction[:, :2] = self.mu
        elif self.explicit:
            m.opt.timestep = internal_step
            # Collisions are looked for, but nothing is done about them.
            m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        mujoco.mj_forward(m, d)
        self.kinematics()

    # Positions

    def kinematics(self):
        """Poses and the screws of all degrees of freedom for the positions as they are."""
        m, d = self.m, self.d
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        angular, linear = self.screws[:3], self.screws[3:]
        rotation = d.xmat[self.first].reshape(3, 3)
        angular[:, 3:6] = rotation
        angular[:, self.hinge] = d.xaxis[1:self.links].T
        anchors = np.empty((3, self.links + 2))
        anchors[:, :3] = d.xpos[self.first][:, None]
        anchors[:, 3:] = d.xanchor[1:self.links].T
        linear[:, 3:5 + self.links] = cross(anchors, angular[:, 3:5 + self.links])
        if self.block >= 0:
            angular[:, -3:] = d.xmat[self.block].reshape(3, 3)
            linear[:, -3:] = cross(d.xpos[self.block][:, None], angular[:, -3:])

    def contacts(self):
        """Points, penetrations, normals, first tangents, rows of both bodies (the normal points to the second), coefficients, eps."""
        d, links = self.d, self.links
        position = d.xpos[self.bodies]
        axis = d.xmat[self.bodies][:, ::3]
        reach = self.half * axis
        centres = np.concatenate([position + reach, position - reach])
        near = np.flatnonzero(centres[:, 2] < self.radius + MARGIN)
        row = self.ends[near]
        points = centres[near]
        depth = self.radius - points[:, 2]
        points[:, 2] -= self.radius
        count = len(near)
        normals = np.broadcast_to(self.up, (count, 3))
        along = axis[row]
        first = np.full(count, links + 1)
        mu = np.broadcast_to(self.mu, (count, 2))
        eps = np.full(count, self.eps)
        mujoco.mj_collision(self.m, d)
        if self.block >= 0:
            corners = d.xpos[self.block] + self.corners @ d.xmat[self.block].reshape(3, 3).T
            low = corners[corners[:, 2] < MARGIN]
            n = len(low)
            points = np.concatenate([points, low])
            depth = np.concatenate([depth, -low[:, 2]])
            normals = np.concatenate([normals, np.broadcast_to(self.up, (n, 3))])
            along = np.concatenate([along, np.broadcast_to((1.0, 0.0, 0.0), (n, 3))])
            first = np.concatenate([first, np.full(n, links + 1)])
            row = np.concatenate([row, np.full(n, links)])
            mu = np.concatenate([mu, np.full((n, 2), self.block_mu)])
            eps = np.concatenate([eps, np.full(n, self.slip * self.block_mu)])
        if d.ncon:
            contact = d.contact
            rows = self.row_of_geom[contact.geom]
            normal = contact.frame[:, :3].copy()
            # The link, else the block, is the second body.
            swap = rows[:, 1] > rows[:, 0]
            swap &= rows[:, 1] >= links
            rows[swap] = rows[swap][:, ::-1]
            normal[swap] *= -1.0
            second = rows[:, 1]
            is_link = second < links
            direction = np.where(is_link[:, None], axis[np.minimum(second, links - 1)], (1.0, 0.0, 0.0))
            block_mu = getattr(self, "block_mu", 0.0)
            points = np.concatenate([points, contact.pos])
            depth = np.concatenate([depth, -contact.dist])
            normals = np.concatenate([normals, normal])
            along = np.concatenate([along, direction])
            first = np.concatenate([first, rows[:, 0]])
            row = np.concatenate([row, second])
            mu = np.concatenate([mu, np.where(is_link[:, None], self.mu, block_mu)])
            eps = np.concatenate([eps, np.where(is_link, self.eps, self.slip * block_mu)])
        tangent = along - normals * np.einsum("ij,ij->i", along, normals)[:, None]
        length = np.sqrt(np.einsum("ij,ij->i", tangent, tangent))
        standing = length < 1e-6
        if standing.any():
            # A link on its end has no direction of its own: any tangent will do.
            other = np.where(np.abs(normals[standing, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
            tangent[standing] = np.cross(normals[standing], other)
            length[standing] = np.linalg.norm(tangent[standing], axis=1)
        tangent /= length[:, None]
        return points, depth, normals, tangent, first, row, mu, eps

    def jacobian(self, points, normals, tangent, first, row):
        """Rows n, t1, t2 of every contact: speed of its second body against its first."""
        count = len(points)
        directions = np.empty((3, count, 3))
        directions[0], directions[1] = normals, tangent
        directions[2] = cross(normals.T, tangent.T).T
        plucker = np.empty((3, count, 6))
        p = points.T[:, None, :]
        e = directions.transpose(2, 0, 1)
        plucker[..., :3] = np.stack(cross_rows(p, e), axis=-1)
        plucker[..., 3:] = directions
        j = (plucker.reshape(-1, 6) @ self.screws).reshape(3, count, self.screws.shape[-1])
        j *= self.moves[row] - self.moves[first]
        return j

    # One internal step

    def forces(self):
        """Everything besides contacts, at the velocities as they are; damping of the joints apart, which is returned."""
        d = self.d
        joint_speed = d.qvel[self.hinge]
        over = np.clip(np.abs(joint_speed) / self.speed_limit - 1.0, 0.0, 1.0)
        damping = self.damping * (1.0 + OVERSPEED_BRAKE * over)
        return self.torque[self.axis_of_joint], damping

    def advance_implicit(self, h):
        m, d = self.m, self.d
        self.kinematics()
        mujoco.mj_crb(m, d)
        mujoco.mj_fullM(m, d, self.matrix)
        mujoco.mj_comVel(m, d)
        mujoco.mj_rne(m, d, 0, self.bias)
        tau, damping = self.forces()
        matrix = self.matrix
        start = d.qvel.copy()
        right = matrix @ start - h * self.bias
        right[self.hinge] += h * (tau - self.stiffness * d.qpos[7:7 + self.links - 1])
        diagonal = np.einsum("ii->i", matrix)
        diagonal[self.hinge] += h * (damping + h * self.stiffness)
        points, depth, normals, tangent, first, row, mu, eps = self.contacts()
        j = self.jacobian(points, normals, tangent, first, row)
        count, nv = len(points), m.nv
        flat = j.reshape(3 * count, nv)
        mu1, mu2 = mu[:, 0], mu[:, 1]
        square, eps2 = np.stack([mu1, mu2]) ** 2, eps * eps
        velocity = start
        gain, pull = np.empty((3, count)), np.empty(count)
        for _ in range(self.iterations):
            speed = (flat @ velocity).reshape(3, count)
            away = speed[0]
            reach = np.maximum(depth - h * away, 0.0)
            give = np.maximum(1.0 - self.h * away, 0.0)
            normal = self.k * reach * give
            gain[0] = self.k * (h * give * (reach > 0.0) + self.h * reach * (give > 0.0))
            gain[1:] = square * (normal / np.sqrt(square[0] * speed[1] ** 2 + square[1] * speed[2] ** 2 + eps2))
            np.add(normal, gain[0] * away, out=pull)
            lhs = matrix + flat.T @ (flat * (h * gain.reshape(-1))[:, None])
            velocity = np.linalg.solve(lhs, right + h * (pull @ j[0]))
        d.qvel[:] = velocity
        mujoco.mj_integratePos(m, d.qpos, d.qvel, h)
        d.time += h

    def advance_explicit(self, _):
        m, d = self.m, self.d
        mujoco.mj_step1(m, d)
        self.kinematics()
        tau, damping = self.forces()
        points, depth, normals, tangent, first, row, mu, eps = self.contacts()
        j = self.jacobian(points, normals, tangent, first, row)
        speed = j @ d.qvel
        normal = self.k * np.maximum(depth, 0.0) * np.maximum(1.0 - self.h * speed[0], 0.0)
        slide = np.sqrt((mu[:, 0] * speed[1]) ** 2 + (mu[:, 1] * speed[2]) ** 2 + eps * eps)
        force = np.stack([normal, -normal * mu[:, 0] ** 2 * speed[1] / slide, -normal * mu[:, 1] ** 2 * speed[2] / slide])
        d.qfrc_applied[:] = force.reshape(-1) @ j.reshape(-1, m.nv)
        # The spring and the damping at rest's speeds are MuJoCo's own.
        d.qfrc_applied[self.hinge] += tau - (damping - self.damping) * d.qvel[self.hinge]
        mujoco.mj_step2(m, d)

    def advance_own(self, _):
        m, d = self.m, self.d
        d.qfrc_applied[self.hinge] = self.torque[self.axis_of_joint]
        mujoco.mj_step(m, d)

    def step(self, dt):
        """Advances by `dt` in equal internal steps, the torques held."""
        count = max(1, math.ceil(dt / self.internal_step - 1e-6))
        h = dt / count
        advance = self.advance_own if self.own_contacts else self.advance_explicit if self.explicit else self.advance_implicit
        if self.own_contacts or self.explicit:
            self.m.opt.timestep = h
        for _ in range(count):
            advance(h)
        self.kinematics()

    # What can be seen

    def state(self):
        d, links = self.d, self.links
        qvel = d.qvel
        twist = (self.screws * qvel) @ self.moves[:links].T
        angular = twist[:3].T
        position = d.xpos[self.bodies]
        linear = (twist[3:] + cross(twist[:3], position.T)).T
        quaternion = d.xquat[self.bodies][:, [1, 2, 3, 0]]
        block = None
        if self.block >= 0:
            turn = d.xmat[self.block].reshape(3, 3)
            block = {"position": d.xpos[self.block].tolist(), "rotation": d.xquat[self.block][[1, 2, 3, 0]].tolist(),
                     "linear": qvel[-6:-3].tolist(), "angular": (turn @ qvel[-3:]).tolist()}
        fields = zip(position.tolist(), quaternion.tolist(), linear.tolist(), angular.tolist())
        state = {
            "type": "state",
            "time": d.time,
            "links": [{"position": p, "rotation": q, "linear": v, "angular": w} for p, q, v, w in fields],
            "joint_angles": d.qpos[7:6 + links].tolist(),
            "joint_speeds": qvel[self.hinge].tolist(),
            "block": block,
        }
        if self.imu:
            rotation = d.xmat[self.bodies].reshape(links, 3, 3)[self.own]
            rate = np.einsum("mji,mj->mi", rotation, angular[self.own])
            state["imu"] = [{"up": u, "rate": w} for u, w in zip(rotation[:, 2].tolist(), rate.tolist())]
        return state


def cross_rows(a, b):
    """The three components of a x b, given by components."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def cross(a, b):
    """a x b, column by column."""
    return np.stack(cross_rows(a, b))


# The protocol


class Session:
    """What one host asks for."""

    def __init__(self, options):
        self.options = options
        self.plant = None
        self.numbers = None

    def answer(self, message):
        """The answer to a message; none ends the session."""
        kind = message.get("type")
        if kind == "hello":
            if message.get("protocol") != PROTOCOL:
                raise Refused(f"this plant speaks {PROTOCOL}, not {message.get('protocol')!r}")
            self.numbers = int(message["modules"]), int(message["links"])
            # The host decides whether it can live with the version; this plant fits any number of modules.
            return {"type": "hello", "protocol": PROTOCOL, "version": VERSION, "modules": self.numbers[0], "links": self.numbers[1],
                    "name": f"MuJoCo {mujoco.__version__}"}
        if kind == "reset":
            if "mjcf" not in message:
                raise Refused("a reset needs the model as `mjcf`")
            o = self.options
            plant = Plant(message["mjcf"], message.get("robot", {}), self.numbers and self.numbers[0],
                          internal_step=o.internal_step, iterations=o.iterations, integrator=o.integrator, own_contacts=o.own_contacts, imu=o.imu)
            if self.numbers and plant.links != self.numbers[1]:
                raise Refused(f"the model has {plant.links} links and the greeting said {self.numbers[1]}")
            self.plant = plant
            return plant.state()
        if kind == "step":
            if self.plant is None:
                raise Refused("a step came before the first reset")
            torques = np.array(message["torques"], dtype=float)
            dt = float(message["dt"])
            if torques.shape != (self.plant.modules, 2) or not np.isfinite(torques).all():
                raise Refused(f"a step needs a finite torque for both axes of {self.plant.modules} modules")
            if not 0.0 < dt <= 1.0:
                raise Refused("the dt of a step is above 0 and at most 1 s")
            self.plant.torque[:] = torques
            self.plant.step(dt)
            return self.plant.state()
        if kind == "bye":
            return None
        raise Refused(f"a message of type {kind!r} is unknown")


def serve(incoming, outgoing, options):
    """Answers line by line until the host says bye or hangs up."""
    session = Session(options)
    for line in incoming:
        try:
            answer = session.answer(json.loads(line))
        except Refused as error:
            answer = {"type": "error", "message": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            answer = {"type": "error", "message": f"the message makes no sense: {error!r}"}
        except np.linalg.LinAlgError:
            answer = {"type": "error", "message": "the motion has diverged"}
        if answer is None:
            return
        outgoing.write(json.dumps(answer).encode() + b"\n")
        outgoing.flush()


def listen(port, options):
    with socket.create_server(("127.0.0.1", port)) as server:
        print(f"listening on tcp:127.0.0.1:{server.getsockname()[1]}", flush=True)
        while True:
            connection, _ = server.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with connection, connection.makefile("rb") as incoming, connection.makefile("wb") as outgoing:
                try:
                    serve(incoming, outgoing, options)
                except OSError:
                    # It hung up; the next one may come.
                    pass


# The gait


def gait(options):
    """An open-loop travelling wave: yaw torque 0.8 * limit * sin(2 pi t + 2 module), slewed; prints one JSON object."""
    with open(options.model, encoding="utf-8") as file:
        xml = file.read()
    parameters = dict(DEFAULTS)
    if options.mu:
        parameters["friction_along"], parameters["friction_across"] = options.mu
    if options.eps is not None:
        parameters["eps"] = options.eps
    plant = Plant(xml, parameters, internal_step=options.internal_step, iterations=options.iterations, integrator=options.integrator,
                  own_contacts=options.own_contacts)
    dt = options.torque_step or options.internal_step
    steps = round(options.seconds / dt)
    change = plant.torque_slew * dt
    modules = np.arange(plant.modules)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    for step in range(steps):
        command = 0.8 * plant.torque_limit * np.sin(2.0 * math.pi * step * dt + 2.0 * modules)
        plant.torque[:, 0] += np.clip(command - plant.torque[:, 0], -change, change)
        plant.step(dt)
    wall, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    physics = steps * max(1, math.ceil(dt / options.internal_step - 1e-6))
    x, y, z = plant.d.xpos[plant.first].tolist()
    if not math.isfinite(x):
        raise Refused("the motion has diverged: take a smaller --internal-step")
    com = plant.d.xpos[plant.bodies].mean(axis=0)
    contacts = "own" if options.own_contacts else options.integrator
    print(json.dumps({
        "head_x": round(x, 4), "head_y": round(y, 4), "head_z": round(z, 4), "com_x": round(float(com[0]), 4), "seconds": options.seconds, "contacts": contacts,
        "internal_step": options.internal_step, "torque_step": dt, "mu": plant.mu.tolist(),
        "eps": None if options.own_contacts else plant.eps,
        "physics_steps_per_s": round(physics / wall, 1), "physics_steps_per_cpu_s": round(physics / cpu, 1), "times_real_time": round(options.seconds / wall, 3),
        "mujoco": mujoco.__version__,
    }))


def step_length(text):
    """A step as a number of seconds or as a fraction: 1/1000."""
    above, _, below = text.partition("/")
    value = float(above) / float(below or 1.0)
    if not 1e-6 <= value <= 0.1:
        raise argparse.ArgumentTypeError("a step is 0.000001 to 0.1 s")
    return value


def main():
    parser = argparse.ArgumentParser(description="MuJoCo as the plant of COMPOSER's simulated bus.")
    parser.add_argument("--listen", type=int, metavar="PORT", help="serve on this loopback TCP port instead of standard input and output")
    parser.add_argument("--internal-step", type=step_length, metavar="S", help="longest physics step, s or a fraction [1/1000; own contacts: 1/100]")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="iterations of the implicit step [%(default)s]")
    parser.add_argument("--integrator", choices=["implicit", "explicit"], default="implicit", help="explicit: MuJoCo's own step; at most 1/20000 s")
    parser.add_argument("--own-contacts", action="store_true", help="MuJoCo's own contacts instead of the simulator's law")
    parser.add_argument("--imu", action="store_true", help="sense for the modules instead of leaving that to the host's model of the sensors")
    parser.add_argument("--gait", action="store_true", help="run the open-loop gait and print where the head is")
    parser.add_argument("--model", metavar="FILE", help="model for --gait, from `snakectl mjcf`")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the gait [%(default)s]")
    parser.add_argument("--torque-step", type=step_length, metavar="S", help="torques of the gait are held and slewed so long [the internal step]")
    parser.add_argument("--mu", type=float, nargs=2, metavar=("ALONG", "ACROSS"), help="friction of the gait [the model's]")
    parser.add_argument("--eps", type=float, help="regularisation of the gait's friction, units/s [slip speed times the smaller mu: 0.005]")
    options = parser.parse_args()
    if options.internal_step is None:
        options.internal_step = 0.01 if options.own_contacts else INTERNAL_STEP
    if options.iterations < 1:
        parser.error("--iterations is 1 or more")
    try:
        if options.gait:
            if not options.model:
                parser.error("--gait needs --model FILE, from `snakectl mjcf`")
            gait(options)
        elif options.listen is not None:
            listen(options.listen, options)
        else:
            # Whatever prints by mistake must not come between the answers.
            outgoing, sys.stdout = sys.stdout.buffer, sys.stderr
            serve(sys.stdin.buffer, outgoing, options)
    except (Refused, OSError) as error:
        sys.exit(f"mujoco_plant.py: {error}")
    except (KeyboardInterrupt, BrokenPipeError):
        sys.exit(130)


if __name__ == "__main__":
    main()
