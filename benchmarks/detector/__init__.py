"""Which parts of the generator a detector needs: the published experiment, on real photographs."""
