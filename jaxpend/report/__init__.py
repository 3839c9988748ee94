"""What a person looks at: charts, the animation, and the page about a run."""
