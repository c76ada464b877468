"""Names of structures that say what is there and not whose it is.

A segmentation's names are free text, and some hold a patient's. Of those that come from a file only
names made of known words are kept; those that a person writes here are checked for their form.

>>> from us_sim.volume.structure_terms import is_anatomical, problem_with
>>> is_anatomical("left portal vein 2"), is_anatomical("Doe Jane liver")
(True, False)
>>> problem_with("lesion of 12/03/1961")
'must begin with a letter or digit, and hold letters, digits, blanks, - and _ only'
"""

from __future__ import annotations

import re

__all__ = ["is_anatomical", "problem_with", "readable"]

_TEXT = """
    abdominal abscess achilles adipose adrenal aneurysm anterior aorta aortic appendix arch arm
    arteria arteries artery articular ascending atrium atrial axilla axillary background basilic
    biceps bicipital bifurcation bile bladder blood body bone bones bowel brachial brachialis
    brachiocephalic brain branch branches breast bronchus bursa calcaneus calf capillary capsule
    cardiac carotid carpal cartilage cava caval cavity celiac cephalic cerebral cervical chest
    clavicle coeliac collateral colon common coronary cortex cortical cruciate cyst deep deltoid
    descending diaphragm digital disc distal dorsal duct ductus duodenum elbow epidermis external
    fascia fascicle fat fatty femoral femur fetal fetus fibula finger flexor fluid foot forearm
    foramen forehead gall gallbladder gastric gland great groin hand head heart hepatic hilum hip
    humerus iliac inferior inguinal inner intercostal intermediate internal intestine invisible
    jugular kidney kidneys knee lateral lesion leg ligament ligaments ligamentum liver lobe lobule
    lower lumbar lumen lung lungs lymph main mass medial median medulla meniscus mesenteric middle
    minor major mitral muscle muscles myocardium nail neck nerve nerves nodule node nodes of oblique
    other outer ovary pancreas parenchyma patella patellar pelvis pericardium peripheral peritoneum
    placenta plantar plaque pleura plexus popliteal portal posterior prostate proximal pulmonary
    quadriceps radial radius rectum renal retina rib ribs right root round sacrum saphenous scapula
    sciatic segment septum sheath shadow shoulder sinus skin skull small soft spinal spine spleen
    splenic sternum stomach structure subclavian subcutaneous subscapularis superficial superior
    supraspinatus tarsal temporal tendon tendons testis thigh thorax thrombus thyroid tibia tibial
    tissue toe tongue tooth trachea transverse triceps trigeminal trunk tumor tumour ulna ulnar
    umbilical upper ureter urethra urinary uterus vagus valve varix vas vein veins vena venous
    ventral ventricle vertebra vertebrae vessel vessels wall wrist left artefact air gas water and
"""
_WORDS = frozenset(_TEXT.split())
"""English and Latin words of anatomy as ultrasound shows it, their directions and sides."""

_NUMERAL = re.compile(r"\d{1,2}|[ivx]{1,4}[ab]?|[a-d]|[lctsr]\d{1,2}")
_LONGEST = 60


def is_anatomical(name: str) -> bool:
    """Whether a name is made of words of anatomy, sides and numbers up to two digits alone."""
    words = readable(name).lower().split()
    known = [word in _WORDS or _NUMERAL.fullmatch(word) is not None for word in words]
    return 0 < len(words) <= 8 and all(known) and any(word in _WORDS for word in words)


def readable(name: str) -> str:
    """A name with blanks in place of underscores, dots and hyphens, as programs write them."""
    return " ".join(re.sub(r"[_\-.,]+", " ", name).split())


def problem_with(name: str) -> str | None:
    """What keeps a text that a person wrote from being a structure's name; None where it is one."""
    if not name.strip() or len(name) > _LONGEST or not name.isprintable():
        return f"must have 1 to {_LONGEST} printable characters"
    if not re.fullmatch(r"[^\W_][\w \-']*", name):
        return "must begin with a letter or digit, and hold letters, digits, blanks, - and _ only"
    if re.search(r"\d{3}", name) or re.search(r"\d\W+\d", name):
        return (
            "has a number of three digits or more, or several, which may be a date or an identity"
        )
    return None
