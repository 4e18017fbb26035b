"""Studies of the paper and of unjam itself, which the command `unjam reproduce` runs."""
