"""What did an experiment find? One page from the files on disk, whatever condition they are in."""
