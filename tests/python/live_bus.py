"""Talks to a robot over a serial CAN adapter with python-can, and reads every frame by the robot's DBC file with cantools.

    live_bus.py ADAPTER DBC MODULES

Listens, arms the robot, tells it a goal, and stops it. Prints what it saw as one JSON object; whatever is not as it should be ends it with a traceback.
"""

import collections
import json
import sys
import time

import can
import cantools

STATION = 127


class Robot:
    """A bus, its database, and what was heard."""

    def __init__(self, adapter, dbc, modules):
        self.database = cantools.database.load_file(dbc)
        self.bus = can.Bus(interface="slcan", channel=adapter, sleep_after_open=0.1)
        self.modules = modules
        self.heard = collections.Counter()
        self.angles = {}

    def send(self, name, **signals):
        message = self.database.get_message_by_name(name)
        data = message.encode(signals)
        frame = can.Message(
            arbitration_id=message.frame_id, is_extended_id=False, is_fd=message.is_fd, bitrate_switch=message.is_fd, data=data
        )
        self.bus.send(frame)

    def receive(self, timeout):
        """The next frame: its name, its sender, its signals. None if there is none."""
        frame = self.bus.recv(timeout)
        if frame is None:
            return None
        message = self.database.get_message_by_frame_id(frame.arbitration_id)
        assert not frame.is_extended_id and not frame.is_remote_frame and not frame.is_error_frame, frame
        assert frame.is_fd == message.is_fd and len(frame.data) == message.length, (frame, message)
        signals = message.decode(frame.data)
        name = message.name.rsplit("_", 1)[0]
        self.heard[name] += 1
        return name, frame.arbitration_id & 0x7F, signals

    def until(self, done, seconds):
        """Hands frames to `done` until it says so."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            got = self.receive(0.05)
            if got and done(*got):
                return
        raise AssertionError(f"not within {seconds} s: {done.__name__}; heard {dict(self.heard)}")


def main():
    adapter, dbc, modules = sys.argv[1], sys.argv[2], int(sys.argv[3])
    robot = Robot(adapter, dbc, modules)
    everybody = set(range(modules))

    disarmed = set()

    def all_are_disarmed(name, sender, signals):
        if name == "HEARTBEAT":
            assert signals["mode"] == "disarmed", signals
            disarmed.add(sender)
        return disarmed == everybody

    robot.until(all_are_disarmed, 10)

    robot.send("SERVICE_REQUEST_STATION", destination=255, operation="ARM", sequence=77, index=0, value=0)
    armed = set()

    def all_say_that_they_are_armed(name, sender, signals):
        if name == "SERVICE_RESPONSE" and signals["sequence"] == 77:
            assert (signals["operation"], signals["code"]) == ("ARM", "Ok"), signals
            armed.add(sender)
        return armed == everybody

    robot.until(all_say_that_they_are_armed, 5)

    # Drives for two seconds: each cycle's SYNC is answered with the goal, ten units ahead and to the left.
    active, travelled = set(), collections.Counter()
    end = time.monotonic() + 2

    def it_has_driven(name, sender, signals):
        if name == "SYNC":
            cycle = signals["cycle"] & 0xFF
            robot.send("GOAL_STATION", cycle=cycle, known=1, point=0, position_0=10.0, position_1=3.0, position_2=0.0)
        if name == "HEARTBEAT" and signals["mode"] == "active":
            active.add(sender)
        if name == "STATE":
            angle = signals["angle_0"]
            travelled[sender] += abs(angle - robot.angles.get(sender, angle))
            robot.angles[sender] = angle
        return time.monotonic() > end and active == everybody

    robot.until(it_has_driven, 10)
    assert min(travelled[module] for module in everybody) > 0.02, travelled

    robot.send("EMERGENCY_STOP_STATION", command="stop", reason=0, counter=0)
    asked = time.monotonic()
    stopped = set()

    def all_are_stopped(name, sender, signals):
        if name == "STATE" and signals["health"] & 4 and not signals["health"] & 2:
            stopped.add(sender)
        return stopped == everybody

    robot.until(all_are_stopped, 2)
    took = time.monotonic() - asked
    # What was sent came out nowhere.
    assert not any(name in robot.heard for name in ("GOAL", "SERVICE_REQUEST")), robot.heard
    robot.bus.shutdown()
    print(json.dumps({"heard": robot.heard, "travelled": min(travelled.values()), "stopped_after": took}))


main()
