//! Frame files: NumPy's .npy, shape (T, Ny, Nx) or (Ny, Nx), C order, f4, f8, u1 or u2. Read and written
//! frame by frame in constant memory.

mod dtype;
mod error;
mod header;
mod reader;
mod writer;

pub use dtype::Dtype;
pub use error::Error;
pub use header::Header;
pub use reader::Reader;
pub use writer::Writer;
