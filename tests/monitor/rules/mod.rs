mod co_located;
mod inputs;
mod known_light;
mod mismatch;
mod pose;
mod unclaimed;
mod unseen;
mod zone;
