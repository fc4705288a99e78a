"""Analysis of runs: summary, claims, fidelity, replay; of scenarios: certificates, margin, adversary."""
