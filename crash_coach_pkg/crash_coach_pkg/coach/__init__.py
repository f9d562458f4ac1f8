"""Who crashes, when and how; and how the crash rate moves."""
