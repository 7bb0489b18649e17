"""Variables by which libraries compute as they do on another CPU. They are read when a library is
loaded, so each setting needs a process of its own.
"""

AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
KERNELS = (
    {"NPY_DISABLE_CPU_FEATURES": AVX512},
    {"NPY_DISABLE_CPU_FEATURES": f"AVX2 FMA3 {AVX512}"},
    {"OPENBLAS_CORETYPE": "Prescott"},
    {"MKL_CBWR": "COMPATIBLE"},
    {"MKL_CBWR": "AVX2"},
    {"ATEN_CPU_CAPABILITY": "default"},
    {"ATEN_CPU_CAPABILITY": "avx2"},
)
THREADS = ({"OMP_NUM_THREADS": "1"}, {"OMP_NUM_THREADS": "2"})


def name_of(setting: dict[str, str]) -> str:
    """The variable of a setting and the first of its values."""
    ((variable, value),) = setting.items()
    return f"{variable}={value.split()[0]}"
