"""Prints how many messages an MCAP file has, topic by topic, as one JSON object: `recording.py FILE`. It has to be whole, checksums included."""

import collections
import json
import sys

from mcap.reader import make_reader

with open(sys.argv[1], "rb") as stream:
    reader = make_reader(stream, validate_crcs=True)
    counts = collections.Counter(channel.topic for _, channel, _ in reader.iter_messages())
    statistics = reader.get_summary().statistics
    assert statistics.message_count == sum(counts.values()), (statistics, counts)
print(json.dumps(counts))
