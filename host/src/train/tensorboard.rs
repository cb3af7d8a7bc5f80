//! TensorBoard event files, written by hand: scalars only.
//!
//! A file is a sequence of records: length (u64), masked CRC-32C of the length, an `Event` protobuf, its masked CRC-32C; all
//! little-endian. See `tensorflow/core/lib/io/record_writer.cc` and `tensorflow/core/util/event.proto`.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

const CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);

/// TensorFlow's mask, which keeps the checksum of data that holds checksums meaningful.
fn masked_crc(data: &[u8]) -> u32 {
    CRC.checksum(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// Frames one record.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut out = Vec::with_capacity(data.len() + 16);
    out.extend_from_slice(&length);
    out.extend_from_slice(&masked_crc(&length).to_le_bytes());
    out.extend_from_slice(data);
    out.extend_from_slice(&masked_crc(data).to_le_bytes());
    out
}

/// A protobuf message in the making: just the three wire types that events need.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn varint(mut self, field: u64, value: u64) -> Self {
        self.raw_varint(field << 3);
        self.raw_varint(value);
        self
    }

    fn double(mut self, field: u64, value: f64) -> Self {
        self.raw_varint(field << 3 | 1);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn float(mut self, field: u64, value: f32) -> Self {
        self.raw_varint(field << 3 | 5);
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn bytes(mut self, field: u64, value: &[u8]) -> Self {
        self.raw_varint(field << 3 | 2);
        self.raw_varint(value.len() as u64);
        self.0.extend_from_slice(value);
        self
    }
}

/// `Event { wall_time: 1, step: 2, file_version: 3 | summary: 5 | session_log: 7 }`
fn event(wall_time: f64, step: u64) -> Message {
    Message::default().double(1, wall_time).varint(2, step)
}

/// `Summary { value: 1 }`, `Value { tag: 1, simple_value: 2 }`
fn summary(scalars: &[(String, f64)]) -> Message {
    scalars.iter().fold(Message::default(), |summary, (tag, value)| {
        summary.bytes(1, &Message::default().bytes(1, tag.as_bytes()).float(2, *value as f32).0)
    })
}

/// An event file being written.
#[derive(Debug)]
pub struct EventWriter {
    file: BufWriter<File>,
}

impl EventWriter {
    /// Starts a new event file in `folder`. `from_step` tells TensorBoard that whatever an earlier file says of later steps is void.
    pub fn create(folder: &Path, from_step: u64) -> io::Result<Self> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        // TensorBoard reads the files of a folder in the order of their names.
        let stem = format!("events.out.tfevents.{:010}.{:09}.composer", now.as_secs(), now.subsec_nanos());
        let mut writer = Self { file: BufWriter::new(File::create_new(folder.join(stem))?) };
        writer.write(&Message::default().double(1, now.as_secs_f64()).bytes(3, b"brain.Event:2"))?;
        // SessionLog { status: START = 1 }
        writer.write(&event(now.as_secs_f64(), from_step).bytes(7, &Message::default().varint(1, 1).0))?;
        writer.file.flush()?;
        Ok(writer)
    }

    fn write(&mut self, message: &Message) -> io::Result<()> {
        self.file.write_all(&record(&message.0))
    }

    /// Writes scalars of one step; numbers that are not finite are left out.
    pub fn scalars(&mut self, step: u64, scalars: &[(String, f64)]) -> io::Result<()> {
        let finite: Vec<_> = scalars.iter().filter(|(_, value)| value.is_finite()).cloned().collect();
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.write(&event(now.as_secs_f64(), step).bytes(5, &summary(&finite).0))?;
        self.file.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_crc32c_masked() {
        // RFC 3720, B.4: 32 bytes of zeros.
        assert_eq!(CRC.checksum(&[0; 32]), 0x8a91_36aa);
        assert_eq!(CRC.checksum(b"123456789"), 0xe306_9283);
        // The masked checksum of the length 24, which opens every TensorBoard file whose first event has 24 bytes.
        assert_eq!(record(&[0; 24])[..12], [24, 0, 0, 0, 0, 0, 0, 0, 0xa3, 0x7f, 0x4b, 0x22]);
    }

    #[test]
    fn a_scalar_event_has_the_bytes_protoc_gives() {
        let bytes = event(1.5, 300).bytes(5, &summary(&[("a/b".into(), 2.0)]).0).0;
        let expected = [
            0x09, 0, 0, 0, 0, 0, 0, 0xf8, 0x3f, // wall_time 1.5
            0x10, 0xac, 0x02, // step 300
            0x2a, 0x0c, 0x0a, 0x0a, // summary of 12 bytes, value of 10
            0x0a, 0x03, b'a', b'/', b'b', // tag
            0x15, 0, 0, 0, 0x40, // simple_value 2
        ];
        assert_eq!(bytes, expected);
    }

    #[test]
    fn a_file_is_whole_records() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(folder.path(), 0).unwrap();
        writer.scalars(7, &[("x".into(), 1.0), ("nan".into(), f64::NAN)]).unwrap();
        let path = std::fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(path).unwrap();
        let (mut at, mut records) = (0, 0);
        while at < bytes.len() {
            let length = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
            let data = &bytes[at + 12..at + 12 + length];
            assert_eq!(record(data), bytes[at..at + 16 + length]);
            assert!(!data.windows(3).any(|window| window == b"nan"));
            at += 16 + length;
            records += 1;
        }
        assert_eq!((at, records), (bytes.len(), 3));
    }
}
