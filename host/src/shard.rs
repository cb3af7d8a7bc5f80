//! Parts of a long work, for several processes or machines: `--shard I/N`.

/// One part of the work: number `index` of `of`, from 1 on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Which part.
    pub index: usize,
    /// How many there are.
    pub of: usize,
}

impl Shard {
    /// The whole of it.
    pub const WHOLE: Shard = Shard { index: 1, of: 1 };

    /// What belongs to this part: every `of`-th, so that each part has some of what is slow.
    pub fn select<T>(self, all: impl IntoIterator<Item = T>) -> impl Iterator<Item = T> {
        all.into_iter().skip(self.index - 1).step_by(self.of)
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match numbers {
            Some((index, of)) if (1..=of).contains(&index) => Ok(Shard { index, of }),
            Some((_, of)) => {
                Err(format!("there is no shard {text}: of {of} shards the first is 1/{of}, the last {of}/{of}"))
            }
            None => Err(format!("`{text}` is no shard: write which one and of how many, such as 2/8")),
        }
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.index, self.of)
    }
}
