"""What sensors measured (metres, radians, stamps in nanoseconds), and what is counted by input and reason."""
