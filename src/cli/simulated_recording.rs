//! Writes a simulated recording: frames.npy, truth.ndjson, claims.ndjson and the poses of a platform that moves, which hold the same frames even after an error.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::frames::npy;
use crate::pose::Pose;
use crate::scene::SimulatedFrame;

/// Why a file of the recording could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("{path}: {reason}")]
    Io { path: PathBuf, reason: io::Error },
    #[error(transparent)]
    Npy(#[from] npy::Error),
}

/// Writes batches of frames. The lines of a batch are written before its frames; the header of frames.npy counts complete frames,
/// and after a failed write the lines are truncated to them.
#[derive(Debug)]
pub struct Recording {
    frames: npy::Writer,
    truth: Lines,
    claims: Lines,
    poses: Option<Lines>,
}

#[derive(Debug)]
struct Lines {
    path: PathBuf,
    file: File,
    length: u64,
}

impl Recording {
    /// Creates `folder` and, in it, the files without a frame; that of poses where the platform moves. `shape` is (Ny, Nx).
    pub fn create(folder: &Path, shape: (usize, usize), moves: bool) -> Result<Self, WriteError> {
        std::fs::create_dir_all(folder).map_err(|reason| WriteError::Io {
            path: folder.to_owned(),
            reason,
        })?;
        Ok(Self {
            frames: npy::Writer::create(folder.join("frames.npy"), shape)?,
            truth: Lines::create(folder.join("truth.ndjson"))?,
            claims: Lines::create(folder.join("claims.ndjson"))?,
            poses: moves.then(|| Lines::create(folder.join("poses.ndjson"))).transpose()?,
        })
    }

    /// Frames that the files hold.
    pub fn frames(&self) -> u64 {
        self.frames.frames()
    }

    /// Appends frames. After an error the files hold those that were written completely.
    pub fn append(&mut self, batch: &[SimulatedFrame]) -> Result<(), WriteError> {
        let before = self.frames();
        let done = self.append_parts(batch);
        if done.is_err() {
            // The first error is the one to report.
            let kept = &batch[..(self.frames() - before) as usize];
            let _ = self.truth.cut_to(kept, truth_lines);
            let _ = self.claims.cut_to(kept, claim_lines);
            if let Some(poses) = &mut self.poses {
                let _ = poses.cut_to(kept, pose_lines);
            }
        }
        done
    }

    /// Appends the poses after the last frame.
    pub fn append_poses(&mut self, poses: &[Pose]) -> Result<(), WriteError> {
        let lines: Vec<u8> = poses.iter().flat_map(pose_line).collect();
        self.poses.as_mut().map_or(Ok(()), |file| file.append(&lines))
    }

    fn append_parts(&mut self, batch: &[SimulatedFrame]) -> Result<(), WriteError> {
        let truth: Vec<u8> = batch.iter().flat_map(truth_lines).collect();
        let claims: Vec<u8> = batch.iter().flat_map(claim_lines).collect();
        self.truth.append(&truth)?;
        self.claims.append(&claims)?;
        let poses: Vec<u8> = batch.iter().flat_map(pose_lines).collect();
        if let Some(file) = &mut self.poses {
            file.append(&poses)?;
        }
        for simulated in batch {
            self.frames.push(simulated.frame.pixels.view())?;
        }
        self.truth.length += truth.len() as u64;
        self.claims.length += claims.len() as u64;
        if let Some(file) = &mut self.poses {
            file.length += poses.len() as u64;
        }
        Ok(())
    }
}

fn truth_lines(simulated: &SimulatedFrame) -> Vec<u8> {
    line(&simulated.truth)
}

fn claim_lines(simulated: &SimulatedFrame) -> Vec<u8> {
    simulated.claims.iter().flat_map(line).collect()
}

fn pose_lines(simulated: &SimulatedFrame) -> Vec<u8> {
    simulated.poses.iter().flat_map(pose_line).collect()
}

/// As files of `[platform] poses` have it.
fn pose_line(pose: &Pose) -> Vec<u8> {
    let [x_m, y_m, z_m] = pose.position_m;
    let q = pose.attitude.quaternion();
    line(&serde_json::json!({
        "time": pose.time,
        "x_m": x_m,
        "y_m": y_m,
        "z_m": z_m,
        "q": [q.w, q.i, q.j, q.k],
        "attitude_sigma_rad": pose.cov[(0, 0)].sqrt(),
        "position_sigma_m": pose.cov[(3, 3)].sqrt(),
    }))
}

fn line(value: &impl serde::Serialize) -> Vec<u8> {
    let mut line = serde_json::to_vec(value).expect("plain data always serialises");
    line.push(b'\n');
    line
}

impl Lines {
    fn create(path: PathBuf) -> Result<Self, WriteError> {
        match File::create(&path) {
            Ok(file) => Ok(Self { path, file, length: 0 }),
            Err(reason) => Err(WriteError::Io { path, reason }),
        }
    }

    fn append(&mut self, bytes: &[u8]) -> Result<(), WriteError> {
        self.file.write_all(bytes).map_err(|reason| WriteError::Io {
            path: self.path.clone(),
            reason,
        })
    }

    /// Truncates the file to the lines before the batch and those of the frames that were `kept`.
    fn cut_to(&mut self, kept: &[SimulatedFrame], lines: impl Fn(&SimulatedFrame) -> Vec<u8>) -> io::Result<()> {
        self.length += kept.iter().map(|f| lines(f).len() as u64).sum::<u64>();
        self.file.set_len(self.length)?;
        self.file.seek(SeekFrom::End(0)).map(drop)
    }
}
