"""Episodes: rollouts for training, greedy ones under crashes, teams of any origin."""
