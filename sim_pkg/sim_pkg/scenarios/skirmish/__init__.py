"""Combat of two teams with SMAC's observations, actions and reward."""
