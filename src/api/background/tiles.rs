//! Map tiles of a folder or an MBTiles file (MBTiles 1.3), by zoom, column and row of the XYZ scheme (rows from the north).

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use rusqlite::{Connection, OpenFlags, OptionalExtension};

use super::config::Error;
use super::raster::{raster_type, read_bounded};

/// Bytes of a tile: those of 256 or 512 pixels take some tens of kB.
const MOST_BYTES: u64 = 1 << 20;
/// Deepest zoom: a tile is then a few metres wide.
const DEEPEST: u8 = 24;
const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// An opened set of tiles.
pub struct Tiles {
    source: Source,
    /// Smallest and largest zoom there is.
    pub zooms: [u8; 2],
}

enum Source {
    /// Its canonical path.
    Folder(PathBuf),
    /// One connection: a tile is read in well under a millisecond.
    Mbtiles(Mutex<Connection>),
}

impl Tiles {
    pub fn open(path: &Path) -> Result<Self, Error> {
        let refuse = |expected: &str, found: String| Error::File {
            key: "tiles",
            path: path.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let whole = |e: std::io::Error| refuse("a folder of tiles z/x/y.png, or an .mbtiles file", e.to_string());
        let canonical = path.canonicalize().map_err(whole)?;
        if canonical.is_dir() {
            let entries = std::fs::read_dir(&canonical).map_err(whole)?;
            let names = entries.filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
            let zooms: Vec<u8> = names.filter(|zoom| *zoom <= DEEPEST).collect();
            let (Some(least), Some(most)) = (zooms.iter().min(), zooms.iter().max()) else {
                return Err(refuse("folders named by their zoom, 0 to 24", "none".to_owned()));
            };
            return Ok(Self {
                zooms: [*least, *most],
                source: Source::Folder(canonical),
            });
        }
        let broken = |e: rusqlite::Error| refuse("a folder of tiles z/x/y.png, or an .mbtiles file", e.to_string());
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let db = Connection::open_with_flags(&canonical, flags).map_err(broken)?;
        let range = "SELECT min(zoom_level), max(zoom_level) FROM tiles WHERE zoom_level BETWEEN 0 AND ?1";
        let zooms: (Option<u8>, Option<u8>) = db
            .query_row(range, [DEEPEST], |row| Ok((row.get(0)?, row.get(1)?)))
            .map_err(broken)?;
        let (Some(least), Some(most)) = zooms else {
            return Err(refuse("tiles", "none".to_owned()));
        };
        let any: Vec<u8> = db
            .query_row("SELECT tile_data FROM tiles LIMIT 1", [], |row| row.get(0))
            .map_err(broken)?;
        if raster_type(&any).is_none() {
            return Err(refuse(
                "tiles of PNG, JPEG or WebP",
                "others, such as vector tiles".to_owned(),
            ));
        }
        Ok(Self {
            zooms: [least, most],
            source: Source::Mbtiles(Mutex::new(db)),
        })
    }

    /// The bytes of a tile; `None` where there is none, and for one that is too large.
    pub fn read(&self, zoom: u8, column: u32, row: u32) -> Option<Vec<u8>> {
        let side = 1_u32.checked_shl(u32::from(zoom)).filter(|_| zoom <= DEEPEST)?;
        if column >= side || row >= side {
            return None;
        }
        match &self.source {
            Source::Folder(root) => EXTENSIONS.iter().find_map(|extension| {
                let path = root.join(format!("{zoom}/{column}/{row}.{extension}"));
                // A link may not lead out of the folder.
                let path = path.canonicalize().ok().filter(|path| path.starts_with(root))?;
                read_bounded(&path, MOST_BYTES).ok()?
            }),
            Source::Mbtiles(db) => {
                // Rows of MBTiles count from the south.
                let select = "SELECT tile_data FROM tiles WHERE zoom_level = ?1 AND tile_column = ?2 AND tile_row = ?3 \
                              AND length(tile_data) <= ?4";
                let db = db.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                let found = db.query_row(select, (zoom, column, side - 1 - row, MOST_BYTES), |row| row.get(0));
                found.optional().ok()?
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PNG: &[u8] = b"\x89PNG\r\n\x1a\nsmall";

    #[test]
    fn a_folder_gives_its_tiles_and_nothing_outside_of_it() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("tiles");
        std::fs::create_dir_all(root.join("3/5")).unwrap();
        std::fs::write(root.join("3/5/2.png"), PNG).unwrap();
        std::fs::write(root.join("3/5/3.png"), vec![0; MOST_BYTES as usize + 1]).unwrap();
        std::fs::write(folder.path().join("secret.png"), PNG).unwrap();
        std::os::unix::fs::symlink(folder.path().join("secret.png"), root.join("3/5/4.png")).unwrap();
        let tiles = Tiles::open(&root).unwrap();
        assert_eq!(tiles.zooms, [3, 3]);
        assert_eq!(tiles.read(3, 5, 2).as_deref(), Some(PNG));
        for (zoom, column, row) in [(3, 5, 3), (3, 5, 4), (3, 5, 9), (3, 9, 2), (200, 0, 0), (2, 0, 0)] {
            assert!(tiles.read(zoom, column, row).is_none(), "{zoom}/{column}/{row}");
        }
        std::fs::remove_dir_all(root.join("3")).unwrap();
        let message = Tiles::open(&root).err().expect("no zoom").to_string();
        assert!(
            message.contains("api.background.tiles") && message.contains("zoom"),
            "{message}"
        );
    }

    #[test]
    fn mbtiles_count_rows_from_the_south() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.mbtiles");
        let db = Connection::open(&path).unwrap();
        let table = "CREATE TABLE tiles (zoom_level INTEGER, tile_column INTEGER, tile_row INTEGER, tile_data BLOB)";
        db.execute(table, []).unwrap();
        assert!(Tiles::open(&path).is_err(), "no tiles");
        let insert = "INSERT INTO tiles VALUES (3, 5, 5, ?1), (4, 0, 0, ?1)";
        db.execute(insert, [PNG]).unwrap();
        let tiles = Tiles::open(&path).unwrap();
        assert_eq!(tiles.zooms, [3, 4]);
        assert_eq!(tiles.read(3, 5, 2).as_deref(), Some(PNG));
        assert!(tiles.read(3, 5, 5).is_none());
        std::fs::write(&path, "no database, but long enough to be none").unwrap();
        assert!(Tiles::open(&path).is_err());
    }
}
