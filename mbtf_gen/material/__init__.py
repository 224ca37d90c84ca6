"""Materials: which maps make one up, how they are read and checked, and what they hold."""
