//! Files in the container format [MCAP](https://mcap.dev/spec), version 0: channels with schemas, messages in chunks that are not compressed, and a summary by
//! which a reader finds its way.
//!
//! The crate `mcap` would do this, but asks its dependencies for features for which burn would be built anew.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};

use composer_shared::CRC_32;

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const MESSAGE_INDEX: u8 = 0x07;
const CHUNK_INDEX: u8 = 0x08;
const STATISTICS: u8 = 0x0b;
const SUMMARY_OFFSET: u8 = 0x0e;
const DATA_END: u8 = 0x0f;

/// Bytes of messages after which a chunk is written.
const CHUNK_SIZE: usize = 128 * 1024;

/// Bytes of a record, put together.
#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }

    /// With its length before it.
    fn bytes(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn text(self, text: &str) -> Self {
        self.bytes(text.as_bytes())
    }
}

fn record(out: &mut Vec<u8>, opcode: u8, content: &Bytes) {
    out.push(opcode);
    out.extend((content.0.len() as u64).to_le_bytes());
    out.extend(&content.0);
}

/// A chunk that has been written.
struct Chunk {
    /// Its first and its last message, ns.
    times: [u64; 2],
    start: u64,
    length: u64,
    indexes: BTreeMap<u16, u64>,
    indexes_length: u64,
    size: u64,
    counts: BTreeMap<u16, u64>,
}

/// Writes an MCAP file. What has gone into whole chunks is in the file even if nobody finishes it; [`Writer::finish`] makes it one that any reader opens.
pub struct Writer {
    file: File,
    /// Where the next chunk begins.
    end: u64,
    /// Schemas and channels, as records.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    schema_count: u16,
    sequences: Vec<u32>,
    /// The messages of the chunk that is not written yet, as records.
    open: Vec<u8>,
    /// Their times and places in it, by their channels.
    places: BTreeMap<u16, Vec<(u64, u64)>>,
    chunks: Vec<Chunk>,
    broken: bool,
}

impl Writer {
    /// Begins a file that is empty.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub fn new(mut file: File, library: &str) -> io::Result<Self> {
        let mut heading = MAGIC.to_vec();
        record(&mut heading, HEADER, &Bytes::default().text("").text(library));
        file.write_all(&heading)?;
        Ok(Writer {
            file,
            end: heading.len() as u64,
            schemas: Vec::new(),
            channels: Vec::new(),
            schema_count: 0,
            sequences: Vec::new(),
            open: Vec::new(),
            places: BTreeMap::new(),
            chunks: Vec::new(),
            broken: false,
        })
    }

    /// A channel whose messages have this schema. Its number.
    pub fn channel(&mut self, topic: &str, schema: &str, schema_encoding: &str, data: &[u8], encoding: &str) -> u16 {
        self.schema_count += 1;
        let id = self.sequences.len() as u16;
        let (mut schemas, mut channels) = (Vec::new(), Vec::new());
        let content = Bytes::default().u16(self.schema_count).text(schema).text(schema_encoding).bytes(data);
        record(&mut schemas, SCHEMA, &content);
        let content = Bytes::default().u16(id).u16(self.schema_count).text(topic).text(encoding).u32(0);
        record(&mut channels, CHANNEL, &content);
        // A reader that goes through the file finds them before the first message; the summary repeats them.
        self.open.extend(schemas.iter().chain(&channels));
        self.schemas.extend(schemas);
        self.channels.extend(channels);
        self.sequences.push(0);
        id
    }

    /// A message at a time, ns.
    ///
    /// # Errors
    ///
    /// If it cannot be written. The file is finished then, with all that came before.
    pub fn message(&mut self, channel: u16, at_ns: u64, data: &[u8]) -> io::Result<()> {
        let sequence = &mut self.sequences[usize::from(channel)];
        self.places.entry(channel).or_default().push((at_ns, self.open.len() as u64));
        let content = Bytes::default().u16(channel).u32(*sequence).u64(at_ns).u64(at_ns).raw(data);
        *sequence = sequence.wrapping_add(1);
        record(&mut self.open, MESSAGE, &content);
        if self.open.len() < CHUNK_SIZE { Ok(()) } else { self.write_chunk() }
    }

    /// Writes the messages so far as a chunk.
    fn write_chunk(&mut self) -> io::Result<()> {
        if self.open.is_empty() || self.broken {
            return Ok(());
        }
        let (open, places) = (std::mem::take(&mut self.open), std::mem::take(&mut self.places));
        let times = places.values().flatten().map(|(time, _)| *time);
        let times = [times.clone().min().unwrap_or(0), times.max().unwrap_or(0)];
        let mut bytes = Vec::with_capacity(open.len() + 4096);
        let content = Bytes::default().u64(times[0]).u64(times[1]).u64(open.len() as u64).u32(CRC_32.checksum(&open));
        record(&mut bytes, CHUNK, &content.text("").u64(open.len() as u64).raw(&open));
        let (length, mut indexes) = (bytes.len() as u64, BTreeMap::new());
        for (channel, places) in &places {
            indexes.insert(*channel, self.end + bytes.len() as u64);
            let entries = places.iter().flat_map(|(time, place)| [time.to_le_bytes(), place.to_le_bytes()].concat());
            let entries: Vec<u8> = entries.collect();
            record(&mut bytes, MESSAGE_INDEX, &Bytes::default().u16(*channel).bytes(&entries));
        }
        if let Err(error) = self.file.write_all(&bytes) {
            // What is whole stays, and what is not makes room for the end of the file.
            self.broken = true;
            let finished = self.close().or_else(|_| {
                self.end = self.chunks.pop().map_or(self.end, |chunk| chunk.start);
                self.close()
            });
            return Err(finished.err().unwrap_or(error));
        }
        self.chunks.push(Chunk {
            times,
            start: self.end,
            length,
            indexes,
            indexes_length: bytes.len() as u64 - length,
            size: open.len() as u64,
            counts: places.iter().map(|(channel, places)| (*channel, places.len() as u64)).collect(),
        });
        self.end += bytes.len() as u64;
        Ok(())
    }

    /// Writes the rest and the end of the file.
    ///
    /// # Errors
    ///
    /// If that cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        if self.broken {
            return Ok(());
        }
        self.write_chunk()?;
        self.close()
    }

    /// The end of the file, behind its last whole chunk.
    fn close(&mut self) -> io::Result<()> {
        self.file.set_len(self.end)?;
        self.file.seek(SeekFrom::Start(self.end))?;
        let mut out = Vec::new();
        record(&mut out, DATA_END, &Bytes::default().u32(0));
        let summary = self.end + out.len() as u64;
        let (begin, mut groups) = (out.len(), Vec::new());
        let mut group = |out: &mut Vec<u8>, opcode: u8, records: &[u8]| {
            groups.push((opcode, self.end + out.len() as u64, records.len() as u64));
            out.extend(records);
        };
        group(&mut out, SCHEMA, &self.schemas);
        group(&mut out, CHANNEL, &self.channels);
        let (mut counts, mut indexes) = (BTreeMap::<u16, u64>::new(), Vec::new());
        for chunk in &self.chunks {
            chunk.counts.iter().for_each(|(channel, count)| *counts.entry(*channel).or_default() += count);
            let offsets = chunk.indexes.iter().flat_map(|(c, at)| [&c.to_le_bytes()[..], &at.to_le_bytes()].concat());
            let offsets: Vec<u8> = offsets.collect();
            let content = Bytes::default().u64(chunk.times[0]).u64(chunk.times[1]).u64(chunk.start).u64(chunk.length);
            let content = content.bytes(&offsets).u64(chunk.indexes_length).text("").u64(chunk.size).u64(chunk.size);
            record(&mut indexes, CHUNK_INDEX, &content);
        }
        group(&mut out, CHUNK_INDEX, &indexes);
        let first = self.chunks.iter().map(|chunk| chunk.times[0]).min().unwrap_or(0);
        let last = self.chunks.iter().map(|chunk| chunk.times[1]).max().unwrap_or(0);
        let statistics = Bytes::default().u64(counts.values().sum()).u16(self.schema_count);
        let statistics = statistics.u32(self.sequences.len() as u32).u32(0).u32(0).u32(self.chunks.len() as u32);
        let by_channel = counts.iter().flat_map(|(c, count)| [&c.to_le_bytes()[..], &count.to_le_bytes()].concat());
        let by_channel: Vec<u8> = by_channel.collect();
        let mut records = Vec::new();
        record(&mut records, STATISTICS, &statistics.u64(first).u64(last).bytes(&by_channel));
        group(&mut out, STATISTICS, &records);
        let offsets = self.end + out.len() as u64;
        for (opcode, start, length) in groups {
            record(&mut out, SUMMARY_OFFSET, &Bytes::default().raw(&[opcode]).u64(start).u64(length));
        }
        // The checksum is of the summary and of the footer up to it.
        let footer = Bytes::default().u64(summary).u64(offsets);
        let mut checked = out[begin..].to_vec();
        checked.push(FOOTER);
        checked.extend(20u64.to_le_bytes());
        checked.extend(&footer.0);
        record(&mut out, FOOTER, &footer.u32(CRC_32.checksum(&checked)));
        out.extend(MAGIC);
        self.file.write_all(&out)?;
        self.file.flush()
    }
}
