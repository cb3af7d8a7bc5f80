//! Messages in the [wire format](https://protobuf.dev/programming-guides/encoding/) of Protocol Buffers, and the descriptors by which readers understand them.

use std::collections::BTreeMap;

/// Foxglove's schemas that are used here and what they consist of, as of <https://github.com/foxglove/foxglove-sdk/tree/main/schemas/proto/foxglove>. A message is a
/// line: its name, then its fields, numbered from 1; `*` marks a list. `enum` before a type says that it is an enumeration within the message, whose values follow in brackets.
pub const FOXGLOVE: &str = "
Quaternion: x double, y double, z double, w double
Vector3: x double, y double, z double
FrameTransform: timestamp google.protobuf.Timestamp, parent_frame_id string, child_frame_id string, translation foxglove.Vector3, rotation foxglove.Quaternion
FrameTransforms: transforms *foxglove.FrameTransform
Color: r double, g double, b double, a double
Pose: position foxglove.Vector3, orientation foxglove.Quaternion
ArrowPrimitive: pose foxglove.Pose, shaft_length double, shaft_diameter double, head_length double, head_diameter double, color foxglove.Color
CubePrimitive: pose foxglove.Pose, size foxglove.Vector3, color foxglove.Color
CylinderPrimitive: pose foxglove.Pose, size foxglove.Vector3, bottom_scale double, top_scale double, color foxglove.Color
KeyValuePair: key string, value string
Point3: x double, y double, z double
LinePrimitive: type enum Type[LINE_STRIP LINE_LOOP LINE_LIST], pose foxglove.Pose, thickness double, scale_invariant bool, points *foxglove.Point3, color foxglove.Color, colors *foxglove.Color, indices *fixed32
ModelPrimitive: pose foxglove.Pose, scale foxglove.Vector3, color foxglove.Color, override_color bool, url string, media_type string, data bytes
SpherePrimitive: pose foxglove.Pose, size foxglove.Vector3, color foxglove.Color
TextPrimitive: pose foxglove.Pose, billboard bool, font_size double, scale_invariant bool, color foxglove.Color, text string
TriangleListPrimitive: pose foxglove.Pose, points *foxglove.Point3, color foxglove.Color, colors *foxglove.Color, indices *fixed32
SceneEntity: timestamp google.protobuf.Timestamp, frame_id string, id string, lifetime google.protobuf.Duration, frame_locked bool, metadata *foxglove.KeyValuePair, arrows *foxglove.ArrowPrimitive, cubes *foxglove.CubePrimitive, spheres *foxglove.SpherePrimitive, cylinders *foxglove.CylinderPrimitive, lines *foxglove.LinePrimitive, triangles *foxglove.TriangleListPrimitive, texts *foxglove.TextPrimitive, models *foxglove.ModelPrimitive
SceneEntityDeletion: timestamp google.protobuf.Timestamp, type enum Type[MATCHING_ID ALL], id string
SceneUpdate: deletions *foxglove.SceneEntityDeletion, entities *foxglove.SceneEntity
";

/// A message, field by field.
#[derive(Clone, Debug, Default)]
pub struct Encoder {
    bytes: Vec<u8>,
}

impl Encoder {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.bytes.push(value as u8);
    }

    fn tag(&mut self, field: u32, wire_type: u64) {
        self.varint(u64::from(field) << 3 | wire_type);
    }

    /// An integer, an enumeration or a truth value.
    pub fn number(mut self, field: u32, value: u64) -> Self {
        self.tag(field, 0);
        self.varint(value);
        self
    }

    /// A double.
    pub fn double(mut self, field: u32, value: f32) -> Self {
        self.tag(field, 1);
        self.bytes.extend(f64::from(value).to_le_bytes());
        self
    }

    /// Several doubles, numbered from 1.
    pub fn doubles(self, values: &[f32]) -> Self {
        values.iter().zip(1..).fold(self, |encoder, (value, field)| encoder.double(field, *value))
    }

    /// A text or bytes.
    pub fn bytes(mut self, field: u32, value: &[u8]) -> Self {
        self.tag(field, 2);
        self.varint(value.len() as u64);
        self.bytes.extend(value);
        self
    }

    /// A text.
    pub fn text(self, field: u32, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    /// A message.
    pub fn message(self, field: u32, value: &Encoder) -> Self {
        self.bytes(field, &value.bytes)
    }

    /// What it is on the wire.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }
}

/// The number of a type in a descriptor, and the name of the message or enumeration that it is.
fn field_type(text: &str) -> (u64, Option<String>) {
    match text {
        "double" => (1, None),
        "fixed32" => (7, None),
        "bool" => (8, None),
        "string" => (9, None),
        "bytes" => (12, None),
        message => (11, Some(format!(".{message}"))),
    }
}

/// The descriptor of a message from its line in [`FOXGLOVE`].
fn descriptor(name: &str, fields: &str) -> Encoder {
    const OPTIONAL: u64 = 1;
    const REPEATED: u64 = 3;
    const ENUM: u64 = 14;
    let mut message = Encoder::default().text(1, name);
    let mut enums = Vec::new();
    for (number, field) in (1..).zip(fields.split(", ")) {
        let (field, of) = field.split_once(' ').unwrap_or((field, ""));
        let mut described = Encoder::default().text(1, field).number(3, number);
        let (label, of) = match of.strip_prefix('*') {
            Some(of) => (REPEATED, of),
            None => (OPTIONAL, of),
        };
        described = described.number(4, label);
        if let Some((of, values)) = of.strip_prefix("enum ").and_then(|of| of.strip_suffix(']')?.split_once('[')) {
            described = described.number(5, ENUM).text(6, &format!(".foxglove.{name}.{of}"));
            let mut described = Encoder::default().text(1, of);
            for (number, value) in (0..).zip(values.split(' ')) {
                described = described.message(2, &Encoder::default().text(1, value).number(2, number));
            }
            enums.push(described);
        } else {
            let (of, name) = field_type(of);
            described = described.number(5, of);
            if let Some(name) = name {
                described = described.text(6, &name);
            }
        }
        message = message.message(2, &described);
    }
    enums.iter().fold(message, |message, described| message.message(4, described))
}

/// A `FileDescriptorSet` with all of [`FOXGLOVE`].
pub fn descriptors() -> Vec<u8> {
    const INT64: u64 = 3;
    const INT32: u64 = 5;
    let proto3 = |file: Encoder| file.text(12, "proto3");
    let google = |name: &str| {
        let field =
            |name: &str, number, of| Encoder::default().text(1, name).number(3, number).number(4, 1).number(5, of);
        let message = Encoder::default().text(1, name);
        let message = message.message(2, &field("seconds", 1, INT64)).message(2, &field("nanos", 2, INT32));
        let path = format!("google/protobuf/{}.proto", name.to_lowercase());
        proto3(Encoder::default().text(1, &path).text(2, "google.protobuf").message(4, &message))
    };
    let mut foxglove = Encoder::default().text(1, "foxglove/foxglove.proto").text(2, "foxglove");
    for path in ["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"] {
        foxglove = foxglove.text(3, path);
    }
    let lines: BTreeMap<&str, &str> = FOXGLOVE.lines().filter_map(|line| line.split_once(": ")).collect();
    for (name, fields) in lines {
        foxglove = foxglove.message(4, &descriptor(name, fields));
    }
    let files = [google("Timestamp"), google("Duration"), proto3(foxglove)];
    files.iter().fold(Encoder::default(), |set, file| set.message(1, file)).finish()
}

/// A time in ns as a `google.protobuf.Timestamp`.
pub fn timestamp(ns: u64) -> Encoder {
    Encoder::default().number(1, ns / 1_000_000_000).number(2, ns % 1_000_000_000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_what_the_specification_says() {
        let inner = Encoder::default().text(1, "ab").number(2, 300);
        let bytes = Encoder::default().message(1, &inner).double(2, 1.0).finish();
        assert_eq!(bytes, [10, 7, 10, 2, b'a', b'b', 16, 0xac, 2, 17, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]);
        assert_eq!(timestamp(2_000_000_003).finish(), [8, 2, 16, 3]);
    }
}
