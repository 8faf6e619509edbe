import os; os.environ['OPENBLAS_NUM_THREADS']='1'
import sys,pickle,glob,time
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.gates import check_pushes
from push_ident.diagnosis.state import DiagnosisState
import push_ident.diagnosis.fits as F
import push_ident.identification.fit as G
rec=pickle.load(open(glob.glob(f'/tmp/lead/tmp_diag/cases/{sys.argv[1]}*.pkl')[0],'rb'))
st=DiagnosisSettings(); s=check_pushes(DiagnosisState(tuple(rec),st,st))
o=F.fit_amplitudes
def fa(*a,**k):
    r=o(*a,**k); print([(f.amplitude,f.status.name,round(f.end.cost,2),round(f.log_evidence,2),f.problem.meter.n_simulations//14) for f in r]); return r
F.fit_amplitudes=fa
F.fit_base(s.records,s.settings)
