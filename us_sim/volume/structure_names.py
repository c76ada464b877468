"""Names of structures, which must not say whose they are, and their colours.

A segmentation's names are free text, and some hold a patient's. Of those that come from a file only
names made of known words are kept; those that a person writes here are checked for their form.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

_TEXT = """
    abdominal abdominis abscess achilles acromioclavicular acromion adductor adenohypophysis adipose
    adrenal air amniotic amygdaloid and aneurysm annulus anterior anus aorta aortic aponeurosis
    appendage appendix aqueduct arachnoid arch arcuate arm artefact arteria arterial arteries artery
    articular ascending atrial atrium autochthon autonomic axilla axillary azygos background basilic
    basilica biceps bicipital bifurcation bile biliary bladder bleeding blood body bone bones bowel
    brachial brachialis brachiocephalic brachioradialis brain branch branches breast bronchi
    bronchus bulb bundle bursa calcaneus calcification calcified calf callosum canal capillary
    capitate capsule carcinoma cardiac carotid carpal carpi cartilage cartilages catheter caudate
    cava caval cavity celiac central cephalic cephalica cerebellar cerebral cervical cervix chest
    chiasm cingulum circulatory circumflex clavicle clavicula clot coccyx coeliac collateral colon
    column commissural commissure common complex condyle connective coracoid cord coronary corpus
    cortex cortical corticospinal costal cranial cruciate csf cuboid cuneiform cyst deep deferent
    deltoid descending diaphragm diencephalon digastric digital digitorum disc dissection distal
    dorsal dorsalis dorsi duct ductus duodenum dura ear edema elbow embolism endocrine endometrium
    epicondyle epidermis epididymis epidural erector esophagus ethmoid extensor external eyeball
    facet fallopian fascia fascicle fasciculus fat fatty feces femoral femoralis femoris femur fetal
    fetus fibers fibroid fibrosus fibula finger flavum flexor fluid follicle foot foramen forearm
    forehead foreign fornix fourth frontal gall gallbladder ganglion gas gastric gastrocnemius
    gastroduodenal gland glands glenoid gluteus gonadal gracilis graft great groin haematoma hamate
    hand head heart hematoma hepatic hepatica hilum hip humerus hyoid iliac iliopsoas ilium implant
    inferior infraspinatus inguinal inner insular intercostal intermediate internal interosseous
    intervertebral intestine invisible ischium jugular jugularis kidney kidneys knee labrum lacrimal
    lamina larynx lateral lateralis latissimus left leg lemniscus lesion lienal ligament ligaments
    ligamentum limb limbic lips liver lobe lobule longitudinal lower lumbar lumborum lumen lunate
    lung lungs lymph lymphatic main major malleolus mandible margin mass masseter mater maxilla
    maximus matter medial medialis median mediastinum medius medulla meninges meniscus mesenteric
    metacarpal metastasis metatarsal midbrain middle minimus minor mitral multifidus muscle muscles
    myocardium myoma myometrium nail navicular neck necrosis needle nerve nerves nervous
    neurohypophysis neuroma nigra node nodes nodule nose nucleus object oblique obliquus occipital
    oesophagus of olecranon omentum optic organ other outer ovary palate palatine pallidum pancreas
    parathyroid paravertebral parenchyma parietal patella patellar patellaris pectoralis peduncle
    pelvis penis perforator perforators pericardial pericardium peripheral peritendon peritoneum
    peroneus phalanges phalanx pharynx pia pineal pisiform pituitary placenta placental plantar
    plantaris plaque pleura plexus pollicis polyp poplitea popliteal portal posterior process
    projection pronator prostate prostatic proximal psoas pterygoid pubis pulmonary pulposus putamen
    quadratus quadriceps radial radialis radiation radius rectum rectus region renal retina
    retinaculum retroperitoneal rib ribs right root round sac sacrum salivary saphena saphenous
    sartorius scalene scalenus scaphoid scapula sciatic scrotum segment semimembranosus seminal
    semitendinosus septum seroma serratus shadow sheath shoulder sinus skeleton skin skull small
    soft soleus space sphenoid spinae spinal spine spinous spleen splenic splenica stenosis stent
    sternocleidomastoid sternum stomach striatum structure subarachnoid subclavia subclavian
    subcutaneous subdeltoid subscapularis substantia superficial superior supinator supraspinatus
    sympathetic synovial synovium system systemic talus target tarsal teeth telencephalon temporal
    tendon tendons teres testicle testis thalamus thenar thigh third thoracic thorax thrombus thymus
    thyroid tibia tibial tibialis tissue toe tongue tooth trachea tract transition transverse
    transversus trapezium trapezius trapezoid tree triceps tricuspid trigeminal triquetrum
    trochanter trunk tube tumor tumour tunnel ulna ulnar ulnaris umbilical uncinate unknown upper
    ureter urethra urinary urine uterus vagus valve varix vas vastus vein veins vena venous ventral
    ventricle ventricular vertebra vertebrae vertebral vesicle vessel vessels vomer wall waste water
    wrist yolk zone zygomatic
"""
_WORDS = frozenset(_TEXT.split())
"""English and Latin words of anatomy, of its directions and sides, and of what is found or put in
a body: those of 3D Slicer's and TotalSegmentator's names, and of muscles, bones and vessels of the
limbs. Words that are many people's names stand in `_PHRASES` with what goes with them."""

_PHRASES = re.compile(r"\b(?:gr[ae]y|white) (?=matter\b)")

_NUMERAL = re.compile(r"\d{1,2}|[ivx]{1,4}[ab]?|[a-d]|[lctsr]\d{1,2}")
_LONGEST = 60


def is_anatomical(name: str) -> bool:
    """Whether a name is made of words of anatomy, sides and numbers up to two digits alone."""
    words = _PHRASES.sub("", readable(name).lower()).split()
    known = [word in _WORDS or _NUMERAL.fullmatch(word) is not None for word in words]
    return 0 < len(words) <= 8 and all(known) and any(word in _WORDS for word in words)


def coded_name(codes: Sequence[str]) -> str:
    """The meaning of SNOMED codes of a type and its modifier; empty where none is known.

    The words are those of pydicom's dictionary of the standard, never a file's own.
    """
    meanings = [_meanings().get(code, "") for code in codes[:2]]
    kind, modifier = (*meanings, "", "")[:2]
    return readable(f"{modifier} {kind}").lower() if kind else ""


@cache
def _meanings() -> Mapping[str, str]:
    try:
        from pydicom.sr.codedict import codes
    except ImportError:
        return {}
    terms = (getattr(codes.SCT, name) for name in codes.SCT.dir())
    # "Structure of right kidney (body structure)" is a right kidney.
    without = re.compile(r"\(.*|\bstructures?( of( the)?)?\b|[^\w ]+", re.IGNORECASE)
    return {term.value: readable(without.sub(" ", term.meaning)) for term in terms}


def readable(name: str) -> str:
    """A name with blanks in place of underscores, dots and hyphens, as programs write them."""
    return " ".join(re.sub(r"[_\-.,]+", " ", name).split())


def problem_with(name: str) -> str | None:
    """The problem with a structure's name that a person wrote; None where there is none."""
    if not name.strip() or len(name) > _LONGEST or not name.isprintable():
        return f"must have 1 to {_LONGEST} printable characters"
    if not re.fullmatch(r"[^\W_][\w \-']*", name):
        return "must begin with a letter or digit, and hold letters, digits, blanks, - and _ only"
    if re.search(r"\d{3}", name) or re.search(r"\d\W+\d", name):
        return (
            "has a number of three digits or more, or several, which may be a date or an identity"
        )
    return None


Colour = tuple[float, float, float]  # red, green and blue, 0 to 1

_COLOURS: dict[str, Colour] = {
    "artery": (0.85, 0.15, 0.15),
    "aorta": (0.85, 0.15, 0.15),
    "vein": (0.25, 0.4, 0.85),
    "cava": (0.25, 0.4, 0.85),
    "portal": (0.25, 0.4, 0.85),
    "vessel": (0.5, 0.3, 0.8),
    "vessels": (0.5, 0.3, 0.8),
    "bone": (0.93, 0.9, 0.8),
    "rib": (0.93, 0.9, 0.8),
    "nerve": (0.95, 0.85, 0.3),
    "fat": (0.95, 0.85, 0.6),
    "muscle": (0.75, 0.35, 0.3),
    "skin": (0.85, 0.7, 0.6),
    "liver": (0.6, 0.3, 0.2),
    "kidney": (0.7, 0.4, 0.3),
    "gallbladder": (0.4, 0.6, 0.3),
    "diaphragm": (0.7, 0.5, 0.5),
}
_ANY_OTHER: Colour = (0.7, 0.6, 0.55)


def anatomical_colour(name: str) -> Colour:
    """Red, green and blue for a structure; of several known words in its name the last one."""
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word in _COLOURS]
    return _COLOURS[words[-1]] if words else _ANY_OTHER


_SHADES = (0.0, 0.45, 0.25, 0.65)  # part of white in the first, second, ... of one colour


def anatomical_colours(names: Iterable[str]) -> dict[str, Colour]:
    """Colours of structures by their names; what has the same `anatomical_colour` gets shades.

    >>> anatomical_colours(["portal vein", "hepatic vein", "liver"])["hepatic vein"]
    (0.588, 0.67, 0.917)
    """
    seen: Counter[Colour] = Counter()
    colours = {}
    for name in names:
        colour = anatomical_colour(name)
        white = _SHADES[seen[colour] % len(_SHADES)]
        seen[colour] += 1
        red, green, blue = (round(part + white * (1.0 - part), 3) for part in colour)
        colours[name] = (red, green, blue)
    return colours
