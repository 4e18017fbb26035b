"""What the paper reports, measured anew: a file for each study."""
