"""Independent frames of non-Gaussian lenses. usage: gen.py OUT kinds snrs layouts sizes frames seed"""
import sys, json, os
import numpy as np
from numpy.fft import fft2, ifft2, fftshift, ifftshift
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import j1
from scipy.optimize import minimize_scalar
OS = 8           # fine samples a pixel
HALF = 28        # pixels
N = 2*HALF*OS+1
ax = (np.arange(N)-N//2)/OS
X, Y = np.meshgrid(ax, ax)
R = np.hypot(X, Y)
def norm(p): return p/p.sum()*OS*OS
def boxed(p):  # integrate over a pixel
    k = np.ones(OS+1); k[0]=k[-1]=.5; k/=OS
    p = np.apply_along_axis(lambda r: np.convolve(r,k,'same'),0,p)
    return np.apply_along_axis(lambda r: np.convolve(r,k,'same'),1,p)
def pupil_psf(scale, zern):
    """scale: lambda N in px; zern(rho,theta)->waves"""
    n=512; L=n//1
    # pupil sampling so that image sample = 1/OS px : lambdaN/du ; D pupil in samples = n*(1/OS)/scale
    d = n*(1/OS)/scale
    c=(np.arange(n)-n//2)
    PX,PY=np.meshgrid(c,c); rho=np.hypot(PX,PY)/(d/2); th=np.arctan2(PY,PX)
    P=(rho<=1)*np.exp(2j*np.pi*zern(rho,th))
    I=np.abs(fftshift(fft2(ifftshift(P))))**2
    m=n//2; h=N//2
    out=np.zeros((N,N)); w=min(h,m-1)
    out[h-w:h+w+1,h-w:h+w+1]=I[m-w:m+w+1,m-w:m+w+1]
    return out
S=2.13
def template(kind, u=(0,0)):
    if kind=='gaussian': return np.exp(-R*R/2/S/S)
    if kind=='airy':
        z=R/(S*2.9)*3.8317; z[z==0]=1e-9; return (2*j1(z)/z)**2
    if kind=='moffat':
        a=S*2.35482/2/np.sqrt(2**(1/2.5)-1)*0.95; return (1+(R/a)**2)**-2.5
    if kind=='disc':
        r=4.2; e=np.clip((r-R)*2+.5,0,1); g=np.exp(-R*R/2/.8**2); return np.real(fftshift(ifft2(fft2(ifftshift(e))*fft2(ifftshift(g)))))
    if kind=='coma':
        f=np.hypot(*u); t=np.arctan2(u[1],u[0])
        return pupil_psf(S/.42*.85, lambda r,th: .25*f*(3*r**3-2*r)*np.cos(th-t))
    if kind=='astig':
        a,b=(X+Y)/2**.5,(X-Y)/2**.5; return np.exp(-a*a/2/2.5**2-b*b/2/1.8**2)
    if kind=='ghost':
        return np.exp(-R*R/2/S/S)+.02*np.exp(-((X-9)**2+(Y+6)**2)/2/S/S)
    if kind=='mghost': return np.exp(-R*R/2/S/S)
class Lens:
    def __init__(s, kind):
        s.kind=kind; s.cache={}
    def get(s,u):
        key=(0,0)
        if s.kind=='coma': key=(round(u[0]*6)/6, round(u[1]*6)/6)
        if key not in s.cache:
            p=norm(template(s.kind,key))
            cx=(p*X).sum()/p.sum(); cy=(p*Y).sum()/p.sum()
            if s.kind=='ghost': cx=cy=0
            # truth is the centroid within 12 px
            if s.kind=='coma':
                m=R<14; cx=(p*X*m).sum()/(p*m).sum(); cy=(p*Y*m).sum()/(p*m).sum()
            s.cache[key]=(spline_filter(boxed(p),3),cx,cy,p)
        return s.cache[key]
    def place(s,n,x,y,sub=None):
        """unit-energy spot with centroid at x,y px (pixel centre integer)"""
        c=(n-1)/2; u=((x-c)/(n/2),(y-c)/(n/2))
        t,cx,cy,_=s.get(u)
        k=np.arange(n)
        gy,gx=np.meshgrid((k-y+cy)*OS+N//2,(k-x+cx)*OS+N//2,indexing='ij')
        im=map_coordinates(t,[gy,gx],order=3,prefilter=False,mode='constant')
        if s.kind=='mghost':
            mx,my=2*c-x,2*c-y
            gy,gx=np.meshgrid((k-my)*OS+N//2,(k-mx)*OS+N//2,indexing='ij')
            im=im+.02*map_coordinates(t,[gy,gx],order=3,prefilter=False,mode='constant')
        return im
    def sigma(s):
        """best Gaussian width over the field"""
        ps=[s.get(u) for u in ([(0,0)] if s.kind!='coma' else [(0,0),(.5,.3),(-.6,.6)])]
        def cost(w):
            tot=0
            for t,cx,cy,p in ps:
                g=np.exp(-((X-cx)**2+(Y-cy)**2)/2/w/w); a=(g*p).sum()/(g*g).sum(); tot+=((p-a*g)**2).sum()
            return tot
        return minimize_scalar(cost,bounds=(1,4),method='bounded').x
def bound(lens,n,pos,en,noise=1e-6):
    J=[];h=.01
    for (x,y),a in zip(pos,en):
        f=lens.place(n,x,y)
        J+= [a*(lens.place(n,x+h,y)-lens.place(n,x-h,y)).ravel()/2/h, a*(lens.place(n,x,y+h)-lens.place(n,x,y-h)).ravel()/2/h, f.ravel()]
    J=np.array(J).T/noise; s=np.sqrt((J*J).sum(0)); J/=s
    C=np.linalg.inv(J.T@J); d=np.diag(C)/s/s
    return [float(d[3*i]+d[3*i+1]) for i in range(len(pos))]
def layout(rng,n,kind,sig):
    c=(n-1)/2
    while True:
        if kind=='sep':
            m=int(rng.integers(5,7)) if n>=48 else 2
            g=2.5 if n>=48 else 1.2; p=rng.uniform(g*sig,n-1-g*sig,(m,2)); least=(6 if n>=48 else 4.2)*sig
            ok=all(np.hypot(*(p[i]-p[j]))>least for i in range(m) for j in range(i))
        elif kind=='close':   # pairs at 2 sigma
            m=3 if n>=48 else 1
            g=4 if n>=48 else 2.5; q=rng.uniform(g*sig,n-1-g*sig,(m,2)); t=rng.uniform(0,2*np.pi,m); d=sig*np.array([np.cos(t),np.sin(t)]).T
            p=np.concatenate([q+d,q-d]); ok=all(np.hypot(*(q[i]-q[j]))>7*sig for i in range(m) for j in range(i))
        if ok: return p
if __name__=='__main__':
    out,kinds,snrs,layouts,sizes,frames,seed=sys.argv[1:8]
    os.makedirs(out,exist_ok=True)
    for kind in kinds.split(','):
        lens=Lens(kind); sig=lens.sigma(); peak=lens.place(33,16,16).max()
        for n in map(int,sizes.split(',')):
            pitch=.03/64; size=pitch*n
            for lay in layouts.split(','):
                for snr in map(int,snrs.split(',')):
                    rng=np.random.default_rng([int(seed),n,snr,hash(kind)%1 if 0 else sum(map(ord,kind+lay))])
                    F=[];T=[]
                    for _ in range(int(frames)):
                        p=layout(rng,n,lay,sig); e=snr*1e-6/peak*rng.uniform(.75,1.25,len(p))
                        im=sum(a*lens.place(n,x,y) for (x,y),a in zip(p,e))+rng.normal(0,1e-6,(n,n))
                        F.append(im); T.append(dict(px=p.tolist(),e=e.tolist(),crb_px2=bound(lens,n,p,e)))
                    name=f'{out}/{kind}-{n}-{lay}-{snr}'
                    np.save(name+'.npy',np.array(F)); json.dump(T,open(name+'.json','w'))
                    open(name+'.toml','w').write(f'[optics]\naltitude_m = 300.0\nlens_radius_m = 0.05\nplane_distance_m = 0.036\npixels = [{n}, {n}]\nsensor_size_m = [{size}, {size}]\nspot_sigma_m = {sig*pitch}\nnoise_std_j = 1e-06\n')
        print(kind,'sigma px',sig,'peak',peak,flush=True)
