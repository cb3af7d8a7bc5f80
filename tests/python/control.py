"""Breaks and mends a simulated robot while it runs, and sees on its bus what comes of it.

    control.py ADAPTER DBC MODULES ADDRESS

Prints what it saw as one JSON object; whatever is not as it should be ends it with a traceback.
"""

import json
import socket
import sys
import time

import can
import cantools


def main():
    adapter, dbc, modules, address = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4]
    host, port = address.rsplit(":", 1)
    control = socket.create_connection((host, int(port)), timeout=10)
    answers = control.makefile("r")

    def command(line):
        control.sendall(line.encode() + b"\n")
        return answers.readline().strip()

    def ok(line):
        answer = command(line)
        assert answer.startswith("ok at ") and answer.endswith(" s"), (line, answer)
        return float(answer.split()[2])

    database = cantools.database.load_file(dbc)
    bus = can.Bus(interface="slcan", channel=adapter, sleep_after_open=0.1)

    def cycles(seconds):
        """Who sends STATE, and what the head of the robot measures at its joints, for so long."""
        seen, end = {}, time.monotonic() + seconds
        while time.monotonic() < end:
            frame = bus.recv(0.05)
            if frame is None:
                continue
            message = database.get_message_by_frame_id(frame.arbitration_id)
            if message.name.startswith("STATE_"):
                seen.setdefault(frame.arbitration_id & 0x7F, []).append(message.decode(frame.data))
        return seen

    def settled(modules, seconds=10):
        """Waits until these modules and no others speak."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            seen = cycles(0.4)
            if set(seen) == modules:
                return seen
        raise AssertionError(f"heard {sorted(seen)} instead of {sorted(modules)}")

    everybody = set(range(modules))
    settled(everybody)
    refused = {}
    for line in ["explode 3", "unplug", f"unplug {modules}", f"cut {modules - 1}", "plug 3", "drop 2", "goal here", "x" * 500]:
        answer = command(line)
        assert answer.startswith("refused: "), (line, answer)
        refused[line.split()[0] if len(line) < 100 else "long"] = answer
    settled(everybody)

    # Module 3 loses its power: the others go on and know that it is gone.
    at = ok("unplug 3")
    seen = settled(everybody - {3})
    assert command("unplug 3") == "refused: module 3 is unplugged already"
    assert all(len(states) >= 4 for states in seen.values()), {module: len(states) for module, states in seen.items()}
    back = ok("plug 3")
    assert back > at + 0.3
    settled(everybody)

    # The cable breaks and is mended; frames get lost; the sensors of a module stick.
    for line in ["cut 3", "mend 3", "drop 0.1", "drop 0", "sensor 5 stuck", "sensor 5 good", "actuator 2 dead", "actuator 2 good", "brownout 4 20ms"]:
        ok(line)
    settled(everybody)

    # The goal moves behind the robot, and the station's orders are obeyed.
    ok("goal -8 3")
    ok("stop")
    stopped = cycles(0.6)
    assert set(stopped) == everybody and all(states[-1]["health"] & 4 for states in stopped.values()), stopped
    ok("release")
    released = cycles(0.6)
    assert all(not states[-1]["health"] & 4 for states in released.values())
    bus.shutdown()
    print(json.dumps({"unplugged_for": back - at, "refused": refused, "help": command("help")}))


main()
