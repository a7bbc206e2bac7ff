mod co_located;
mod inputs;
mod mismatch;
mod pose;
mod unclaimed;
mod unseen;
