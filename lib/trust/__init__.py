"""Can the numbers of a recording be trusted?  Verdicts, diagnoses, the health of the detector, the check of a recording."""

from lib.trust.diagnosis import Diagnosis, diagnose
from lib.trust.fitting import Hypothesis
from lib.trust.health import Health, health
from lib.trust.verdict import LEVELS, LIMITS, Assessment, Reason, Verdict, assess, judge, report

__all__ = ["LEVELS", "LIMITS", "Assessment", "Diagnosis", "Health", "Hypothesis", "Reason", "Verdict"]
__all__ += ["assess", "diagnose", "health", "judge", "report"]
