"""What a sweep tries, and when it stops a trial: search spaces, trials, searches and rules. No Ray, no torch."""
