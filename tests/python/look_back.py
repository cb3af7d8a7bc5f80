"""Opens what a run left behind with the programs that people use: python-can, cantools, MCAP's own reader, and Foxglove's own schemas.

    look_back.py DBC LOG RECORDING MODULES LINKS

Prints what it saw as one JSON object; whatever is not as it should be ends it with a traceback.
"""

import collections
import json
import math
import sys

import can
import cantools
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def described(message):
    """The fields of a message of a descriptor."""
    return {f.number: (f.name, f.type, f.label, f.type_name) for f in message.field}


def same_schemas(data, official):
    """Whether every message of ours is Foxglove's, field by field; how many there are."""
    theirs = {}

    def collect(file):
        proto = FileDescriptorProto()
        file.CopyToProto(proto)
        for message in proto.message_type:
            theirs[f"{proto.package}.{message.name}"] = message
        for dependency in file.dependencies:
            collect(dependency)

    for descriptor in official:
        collect(descriptor.file)
    count = 0
    for file in FileDescriptorSet.FromString(data).file:
        for message in file.message_type:
            full_name = f"{file.package}.{message.name}"
            assert described(message) == described(theirs[full_name]), full_name
            ours = {e.name: [(v.name, v.number) for v in e.value] for e in message.enum_type}
            assert ours == {e.name: [(v.name, v.number) for v in e.value] for e in theirs[full_name].enum_type}, full_name
            count += 1
    assert count == len(theirs), (count, sorted(theirs))
    return count


def main():
    dbc, log, recording, modules, links = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
    database = cantools.database.load_file(dbc)

    heard = collections.Counter()
    frames = []
    for frame in can.LogReader(log):
        message = database.get_message_by_frame_id(frame.arbitration_id)
        assert frame.is_fd == message.is_fd and len(frame.data) == message.length, (frame, message)
        message.decode(frame.data)
        heard[message.name.rsplit("_", 1)[0]] += 1
        frames.append((frame.arbitration_id, frame.is_fd, frame.data.hex().upper()))

    with open(recording, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        topics = {channel.topic: channel for channel in summary.channels.values()}
        counts = {topic: summary.statistics.channel_message_counts.get(c.id, 0) for topic, c in topics.items()}
        schema = summary.schemas[topics["/tf"].schema_id]
        assert (schema.name, schema.encoding) == ("foxglove.FrameTransforms", "protobuf")
        schemas = same_schemas(schema.data, [FrameTransforms.DESCRIPTOR, SceneUpdate.DESCRIPTOR])

        seen, last, poses, head = collections.Counter(), 0, [], []
        for schema, channel, message, decoded in reader.iter_decoded_messages(["/tf", "/scene"], log_time_order=False):
            seen[channel.topic] += 1
            # By the reader's schema and by Foxglove's own it is the same.
            official = (FrameTransforms if channel.topic == "/tf" else SceneUpdate).FromString(message.data)
            assert official.SerializeToString(deterministic=True) == decoded.SerializeToString(deterministic=True)
            if channel.topic == "/tf":
                names = [transform.child_frame_id for transform in official.transforms]
                assert names == [f"link_{k}" for k in range(links)] + ["goal"], names
                for transform in official.transforms:
                    r = transform.rotation
                    assert transform.parent_frame_id == "world"
                    assert abs(math.hypot(r.x, r.y, r.z, r.w) - 1) < 1e-4, r
                    assert transform.timestamp.seconds * 10**9 + transform.timestamp.nanos == message.log_time
                head.append(official.transforms[0].translation)
            else:
                ids = [entity.id for entity in official.entities]
                assert len(ids) == links + 1 and all(entity.frame_id for entity in official.entities), ids
                assert official.deletions[0].type == 1
                poses.append([entity.cylinders[0].color for entity in official.entities[:-1]])

        bus, faults, attention = [], [], 0
        for _, channel, message in reader.iter_messages(["/bus", "/joints", "/torques", "/attention", "/modules", "/faults"]):
            assert message.log_time >= last, "in order of time"
            last = message.log_time
            seen[channel.topic] += 1
            value = json.loads(message.data)
            if channel.topic == "/bus":
                bus.append((value["id"], value["fd"], value["data"]))
            elif channel.topic == "/faults":
                faults.append(value["active"])
            elif channel.topic == "/attention":
                attention = max(attention, *(sum(row) for row in value["weights"]))
                assert [len(row) for row in value["weights"]] == [modules] * modules
            elif channel.topic in ("/joints", "/torques"):
                rows = value.get("angles", value.get("applied"))
                assert len(rows) == modules and all(math.isfinite(x) for row in rows for x in row)
    assert dict(seen) == {topic: count for topic, count in counts.items() if count}, (seen, counts)
    assert bus == frames, "the same frames as in the log"
    print(
        json.dumps(
            {
                "heard": heard,
                "counts": counts,
                "schemas": schemas,
                "faults": faults,
                "attention": attention,
                "scenes": len(poses),
                "moved": math.dist([head[0].x, head[0].y], [head[-1].x, head[-1].y]),
            }
        )
    )


main()
