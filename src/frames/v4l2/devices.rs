//! Lists the V4L2 devices of this host with their formats.

use std::io;
use std::path::{Path, PathBuf};

use super::format::{PixelFormat, fourcc_name};
use super::ranking::Offer;
use super::session;
use super::sys::{Node, Sizes};

/// A V4L2 node and its capabilities.
#[derive(Clone, Debug)]
pub struct Device {
    pub card: String,
    pub driver: String,
    pub bus: String,
    /// Whether it can be a source: it captures video by streaming.
    pub captures: bool,
    pub formats: Vec<DeviceFormat>,
    /// What can be used of it, the best first.
    pub ranked: Vec<Offer>,
}

/// A pixel format of a device.
#[derive(Clone, Debug)]
pub struct DeviceFormat {
    pub name: String,
    pub description: String,
    /// What `source.v4l2.pixel_format` calls it, where it can be used.
    pub usable: Option<PixelFormat>,
    pub sizes: Vec<Sizes>,
}

/// Every video node by number, with its capabilities, ranked for a frame rate, or the error of querying it.
pub fn devices(rate_hz: f64) -> io::Result<Vec<(PathBuf, io::Result<Device>)>> {
    let mut nodes: Vec<(u32, PathBuf)> = std::fs::read_dir("/dev")?
        .filter_map(Result::ok)
        .filter_map(|entry| {
            let number = entry.file_name().to_str()?.strip_prefix("video")?.parse().ok()?;
            Some((number, entry.path()))
        })
        .collect();
    nodes.sort();
    Ok(nodes
        .into_iter()
        .map(|(_, path)| (path.clone(), ask(&path, rate_hz)))
        .collect())
}

fn ask(path: &Path, rate_hz: f64) -> io::Result<Device> {
    let node = Node::open(path)?;
    let capability = node.capability().clone();
    let captures = capability.captures && capability.streams;
    let offered = if captures { node.formats() } else { Vec::new() };
    let formats = offered.into_iter().map(|offered| DeviceFormat {
        name: fourcc_name(offered.fourcc),
        description: offered.description,
        usable: PixelFormat::from_fourcc(offered.fourcc),
        sizes: node.sizes(offered.fourcc),
    });
    let in_use = node.format().map_or([0; 2], |f| [f.width, f.height]);
    let ranked = match captures {
        true => session::offers(&node, in_use, rate_hz),
        false => Vec::new(),
    };
    Ok(Device {
        captures,
        ranked,
        formats: formats.collect(),
        card: capability.card,
        driver: capability.driver,
        bus: capability.bus,
    })
}
