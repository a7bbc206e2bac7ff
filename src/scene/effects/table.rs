//! The interface of the tables of `[effects]`.

use crate::toml_file::{Key, OutOfRange};

/// A table of `[effects]`.
pub(in crate::scene) trait Table {
    /// Checks every field; `field` is the table's own name.
    fn validate(&self, field: &Key) -> Result<(), OutOfRange>;
}

impl<T: Table> Table for Vec<T> {
    fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
        let mut items = self.iter().enumerate();
        items.try_for_each(|(k, item)| item.validate(&field.index(k)))
    }
}
