"""Many pairs, without hands: what to do, where it runs, and what is done."""
