"""Drive electronics, safety limiter and virtual bench for piezo deformable mirrors."""
