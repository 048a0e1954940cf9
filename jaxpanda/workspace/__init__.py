"""Where an arm may go: what it can run into, and the limits of its joints."""
