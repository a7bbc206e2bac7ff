mod association;
mod eligibility;
