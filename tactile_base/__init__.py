"""What everything stands on: settings, YAML files, where configuration lies, stamps, topics and frames."""
