//! The API from outside, over real connections.

mod bodies;
mod connections;
mod fake;
mod guards;
mod rest;
mod stream;
mod tokens;
