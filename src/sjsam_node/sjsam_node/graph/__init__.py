"""What is known: submaps, the landmarks that they share, and the links that say so."""
