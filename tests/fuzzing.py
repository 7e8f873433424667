"""How hard parsers of bytes from devices are fuzzed: hundreds of cases in CI, thousands in the nightly profile."""

from hypothesis import HealthCheck, settings

CASES, NIGHTLY_CASES = 500, 20_000


def fuzz_settings(share: float = 1.0) -> settings:
    """Return settings for ``share`` of the cases of the profile in force (`--hypothesis-profile=nightly`: 20,000)."""
    nightly = settings.get_current_profile_name() == "nightly"
    cases = round(share * (NIGHTLY_CASES if nightly else CASES))
    return settings(
        max_examples=cases, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
    )
