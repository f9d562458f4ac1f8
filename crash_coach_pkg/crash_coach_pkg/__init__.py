"""The coach (who crashes, when, how) and the gate (carries it out on command topics)."""
