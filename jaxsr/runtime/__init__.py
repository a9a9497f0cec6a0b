"""Running methods: loading with weights, streaming, schedules, cost."""
