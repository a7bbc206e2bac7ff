//! Comma-separated values after a header that names the columns as `[claims.fields]` does.

use serde_json::{Map, Number, Value};

use crate::claim::Claim;
use crate::claims::config::Config;
use crate::claims::line::{self, LineError};

/// The columns of a file.
#[derive(Clone, Debug)]
pub(super) struct Header {
    columns: Vec<String>,
    delimiter: u8,
}

impl Header {
    /// Reads the first line. Cells are parted by what is most frequent in it of comma, semicolon and tab.
    pub(super) fn read(line: &[u8], config: &Config) -> Result<Self, LineError> {
        let text = line.strip_prefix(line::BYTE_ORDER_MARK).unwrap_or(line);
        let count = |delimiter: &u8| text.iter().filter(|byte| *byte == delimiter).count();
        let delimiter = [b'\t', b';', b','].into_iter().max_by_key(count).unwrap_or(b',');
        let columns: Vec<String> = cells(text, delimiter)?
            .iter()
            .map(|cell| cell.trim().to_owned())
            .collect();
        let fields = &config.fields;
        let local = [&fields.x_m, &fields.y_m];
        let geodetic = [&fields.latitude_deg, &fields.longitude_deg];
        let place = if columns.contains(geodetic[0]) { geodetic } else { local };
        for name in [&fields.time, &fields.user].into_iter().chain(place) {
            if !columns.contains(name) {
                return Err(LineError::Missing {
                    field: name.clone(),
                    expected: "a column of this name in the header",
                });
            }
        }
        Ok(Self { columns, delimiter })
    }

    /// Reads any other line, as if it were a JSON object with the columns as fields. An empty cell is a field left out.
    pub(super) fn row(&self, line: &[u8], config: &Config) -> Result<Claim, LineError> {
        let cells = cells(line, self.delimiter)?;
        if cells.len() != self.columns.len() {
            return Err(LineError::Columns {
                expected: self.columns.len(),
                found: cells.len(),
            });
        }
        let is_text = |name: &str| name == config.fields.user || name == config.fields.state;
        let value = |name: &str, cell: &str| match cell.trim() {
            "" => Value::Null,
            text if is_text(name) => Value::from(text),
            text => text
                .parse()
                .ok()
                .and_then(Number::from_f64)
                .map_or_else(|| Value::from(text), Value::Number),
        };
        let row: Map<String, Value> = self
            .columns
            .iter()
            .zip(&cells)
            .map(|(name, cell)| (name.clone(), value(name, cell)))
            .collect();
        line::parse_object(&Value::Object(row), config)
    }
}

fn cells(line: &[u8], delimiter: u8) -> Result<Vec<String>, LineError> {
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .delimiter(delimiter)
        .from_reader(line);
    let mut row = csv::StringRecord::new();
    reader.read_record(&mut row)?;
    Ok(row.iter().map(str::to_owned).collect())
}
