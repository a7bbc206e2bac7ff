//! The API from outside, over real connections.

mod background;
mod bodies;
mod connections;
mod evidence;
mod fake;
mod fixtures;
mod geojson;
mod guards;
mod rest;
mod stream;
mod tables;
mod tokens;
